"""The steps ask and wait: what can be answered, who is asked how often, and what of it is kept."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol
from fieldkit.core.prompts import DONE, NOBODY, UNKNOWN, Answer, Question
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.steps.kinds.ask import AskStep
from fieldkit.steps.kinds.wait import WaitStep
from fieldkit.steps.scene import Scene
from fieldkit.steps.view import View
from tests.helpers.casts import CAST
from tests.helpers.idle_testbed import IdleTestbed

SCENE = Scene(Protocol.TCP, CAST, "f")
WIND = "column: wind, question: how strong is the wind, unit: m/s, least: 0, most: 40"
GRASS = "column: grass, question: how is the grass, choices: [dry, wet]"


@dataclass
class Talkative:
    """An operator with an answer to everything, who remembers what was asked."""

    says: str
    asked: list[str] = field(default_factory=list)

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        assert not may_skip
        self.asked.append(request)
        return DONE

    def enter(self, question: Question) -> str:
        self.asked.append(question.text)
        answer = question.read(self.says)
        assert answer is not None
        return answer


def ask(text: str) -> AskStep:
    return schema.validate(schema.parse(f"{{{text}}}", source="x.yaml"), AskStep)


def silent(name: str, expected_s: float | None) -> None:
    """Nobody looks."""


def answered(step: AskStep, here: Path, operator: Talkative | None = None) -> View:
    here.mkdir(parents=True)
    testbed = IdleTestbed()
    testbed.operator = operator or NOBODY
    step.run(replace(SCENE, here=here), testbed, silent)
    return View(SCENE, AttemptEvidence(here))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"{GRASS}, unit: m", "they take no unit"),
        (f"{WIND}, choices: [a, b]", "they take no unit"),
        ("column: a, question: b, least: 2, most: 1", "least is above most"),
        (f"{WIND}, usual: strong", "usual is 'strong', and what can be answered is a number in m/s from 0 to 40"),
        (f"{GRASS}, usual: high", "usual is 'high', and what can be answered is 1 dry, 2 wet; - if unknown\n"),
        ("column: a, question: b, choices: [a]", "at least 2 items"),
        ("column: A, question: b", "'A' is not a name: small letters"),
        ("column: a, question: b, unit: 2m", "'2m' is not a unit"),
        ("column: a, question: b, choices: [a, b, a]", "a choice comes twice"),
        ("column: a, question: b, choices: [a, '2']", "choices.1: '2' cannot be a choice: write words"),
        ("column: a, question: b, choices: [a, ' b']", "cannot be a choice"),
        ("column: a, question: b, choices: [a, '-']", "cannot be a choice"),
        ("column: a, question: b, choices: [a, nan]", "cannot be a choice"),
        (f"{WIND}, each: day", "'repeat' or 'trial'"),
    ],
)
def test_what_nobody_could_answer_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(ConfigurationError, match=complaint):
        ask(text)


@pytest.mark.parametrize(
    ("text", "line", "answer"),
    [
        (WIND, "3.50\n", "3.5"),
        (WIND, " 3.5 m/s ", "3.5"),
        (WIND, "3.5 km/h", None),
        (WIND, "41", None),
        (WIND, "-1", None),
        (WIND, "nan", None),
        (WIND, "", None),
        (WIND, "-", UNKNOWN),
        (f"{WIND}, usual: 2m/s", "", "2"),
        (GRASS, "wet", "wet"),
        (GRASS, "2", "wet"),
        (GRASS, "3", None),
        (GRASS, "we", None),
    ],
)
def test_a_line_answers_a_question_or_does_not(text: str, line: str, answer: str | None) -> None:
    assert ask(text)._asked.read(line) == answer


@given(st.floats(allow_nan=False, allow_infinity=False, width=32), st.sampled_from(["", "m/s", "hPa", "e"]))
def test_every_number_that_is_possible_is_read_again(value: float, unit: str) -> None:
    question = Question("how much", unit)
    answer = question.read(f"{value!r} {unit}")
    assert answer is not None
    assert float(answer) == pytest.approx(value, rel=1e-8)
    assert question.read(answer) == answer


def test_an_answer_becomes_a_column_with_its_unit(tmp_path: Path) -> None:
    step = ask(WIND)
    view = answered(step, tmp_path / "a", Talkative("3.5"))
    (column,) = step.output_columns()
    assert (column.name, column.unit, column.possible) == ("wind", "m/s", (0.0, 40.0))
    assert step.measure(view).values == {"wind": 3.5}
    assert list(step.summary({"wind": 3.5})) == ["wind 3.5 m/s"]
    assert not list(step.check(view))


def test_a_word_stays_a_word(tmp_path: Path) -> None:
    step = ask(GRASS)
    assert step.measure(answered(step, tmp_path / "a", Talkative("2"))).values == {"grass": "wet"}
    assert step.output_columns()[0].unit == "text"


def test_who_does_not_know_leaves_the_column_empty_and_the_repeat_valid(tmp_path: Path) -> None:
    for operator in (Talkative("-"), None):
        step = ask(WIND)
        view = answered(step, tmp_path / str(operator is None), operator)
        assert step.measure(view).missing == {"wind": "the operator did not know"}
        assert not list(step.check(view))


def test_where_nobody_is_asked_the_usual_answer_stands(tmp_path: Path) -> None:
    step = ask(f"{GRASS}, usual: dry")
    assert step.measure(answered(step, tmp_path / "a")).values == {"grass": "dry"}


@pytest.mark.parametrize(("each", "times"), [("trial", 1), ("repeat", 3)])
def test_a_question_is_asked_once_per_trial_or_in_each_repeat(tmp_path: Path, each: str, times: int) -> None:
    operator, step = Talkative("7"), ask(f"{WIND}, each: {each}")
    views = [answered(step, tmp_path / "trial" / "repeats" / name, operator) for name in ("b", ".a", "c")]
    assert len(operator.asked) == times
    assert [step.measure(view).values for view in views] == [{"wind": 7.0}] * 3
    answered(step, tmp_path / "other" / "repeats" / "a", operator)
    assert len(operator.asked) == times + 1


@pytest.mark.parametrize("text", ["", "\n", "strong\n", "99\n", "3\n4\n"])
def test_a_file_that_answers_nothing_voids_the_repeat(tmp_path: Path, text: str) -> None:
    (tmp_path / "answer-wind.txt").write_text(text, encoding="utf-8")
    step, view = ask(WIND), View(SCENE, AttemptEvidence(tmp_path))
    assert list(step.check(view)) == ["answer-wind.txt does not say what the operator answered"]
    assert step.measure(view).missing


def wait(text: str) -> WaitStep:
    return schema.validate(schema.parse(f"{{{text}}}", source="x.yaml"), WaitStep)


@pytest.mark.parametrize("text", ["", "duration: 1s, until: open the door", "duration: 0s", "until: ''"])
def test_a_wait_waits_for_one_thing(text: str) -> None:
    with pytest.raises(ConfigurationError):
        wait(text)


def test_a_wait_ends_with_its_time_or_with_the_operator_s_word() -> None:
    operator, testbed = Talkative(""), IdleTestbed()
    testbed.operator = operator
    wait("until: open the door").run(SCENE, testbed, silent)
    assert operator.asked == ["open the door"]
    phases: list[tuple[str, float | None]] = []
    wait("duration: 1ms").run(SCENE, testbed, lambda *phase: phases.append(phase))
    assert phases == [("wait", 0.001)]
    assert list(wait("duration: 2s").dry_run_notes(SCENE)) == ["wait 2 s"]
