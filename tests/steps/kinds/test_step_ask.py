"""The steps `ask` and `wait`: valid answers, the number of prompts, and stored answers."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Protocol
from fieldkit.core.prompts import DONE, UNATTENDED, UNKNOWN, Answer, Question
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
class ScriptedOperator:
    """An operator with one answer to all questions; records the questions."""

    answer: str
    questions: list[str] = field(default_factory=list)

    def ask(self, request: str, *, may_skip: bool = False) -> Answer:
        assert not may_skip
        self.questions.append(request)
        return DONE

    def enter(self, question: Question) -> str:
        self.questions.append(question.text)
        answer = question.read(self.answer)
        assert answer is not None
        return answer


def ask(text: str) -> AskStep:
    return schema.validate(schema.parse(f"{{{text}}}", source="x.yaml"), AskStep)


def ignore(name: str, expected_s: float | None) -> None:
    """Ignore a phase."""


def run_and_view(step: AskStep, folder: Path, operator: ScriptedOperator | None = None) -> View:
    folder.mkdir(parents=True)
    testbed = IdleTestbed()
    testbed.operator = operator or UNATTENDED
    step.run(replace(SCENE, laptop_folder=folder), testbed, ignore)
    return View(SCENE, AttemptEvidence(folder))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{GRASS}, unit: m", "they have no unit"),
        (f"{WIND}, choices: [a, b]", "they have no unit"),
        ("column: a, question: b, least: 2, most: 1", "least is greater than most"),
        (f"{WIND}, usual: strong", "usual is 'strong'; permitted answers: a number in m/s from 0 to 40"),
        (f"{GRASS}, usual: high", "usual is 'high'; permitted answers: 1 dry, 2 wet; - if unknown\n"),
        ("column: a, question: b, choices: [a]", "at least 2 items"),
        ("column: A, question: b", "'A' is not a name of at most 31 lower-case letters"),
        ("column: a, question: b, unit: 2m", "'2m' is not a unit"),
        ("column: a, question: b, choices: [a, b, a]", "a choice is listed twice"),
        ("column: a, question: b, choices: [a, '2']", "choices.1: '2' cannot be a choice: write words"),
        ("column: a, question: b, choices: [a, ' b']", "cannot be a choice"),
        ("column: a, question: b, choices: [a, '-']", "cannot be a choice"),
        ("column: a, question: b, choices: [a, nan]", "cannot be a choice"),
        (f"{WIND}, each: day", "'day' is not one of: repeat, trial"),
    ],
)
def test_invalid_question_is_rejected(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
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
def test_typed_answers_are_read_or_rejected(text: str, line: str, answer: str | None) -> None:
    assert ask(text)._full_question.read(line) == answer


@given(st.floats(allow_nan=False, allow_infinity=False, width=32), st.sampled_from(["", "m/s", "hPa", "e"]))
def test_a_read_number_is_read_again_unchanged(value: float, unit: str) -> None:
    question = Question("how much", unit)
    answer = question.read(f"{value!r} {unit}")
    assert answer is not None
    assert float(answer) == pytest.approx(value, rel=1e-8)
    assert question.read(answer) == answer


def test_the_answer_to_a_number_question_is_in_a_column_with_its_unit(tmp_path: Path) -> None:
    step = ask(WIND)
    view = run_and_view(step, tmp_path / "a", ScriptedOperator("3.5"))
    (column,) = step.output_columns()
    assert (column.name, column.unit, column.possible_range) == ("wind", "m/s", (0.0, 40.0))
    assert step.measure(view).values == {"wind": 3.5}
    assert list(step.summary({"wind": 3.5})) == ["wind 3.5 m/s"]
    assert not list(step.check(view))


def test_the_answer_to_a_choice_question_is_in_a_text_column(tmp_path: Path) -> None:
    step = ask(GRASS)
    assert step.measure(run_and_view(step, tmp_path / "a", ScriptedOperator("2"))).values == {"grass": "wet"}
    assert step.output_columns()[0].unit == "text"


def test_with_an_unknown_answer_the_column_is_empty_and_the_repeat_valid(tmp_path: Path) -> None:
    for operator in (ScriptedOperator("-"), None):
        step = ask(WIND)
        view = run_and_view(step, tmp_path / str(operator is None), operator)
        assert step.measure(view).missing == {"wind": "the operator answered: unknown"}
        assert not list(step.check(view))


def test_usual_answer_is_used_without_operator(tmp_path: Path) -> None:
    step = ask(f"{GRASS}, usual: dry")
    assert step.measure(run_and_view(step, tmp_path / "a")).values == {"grass": "dry"}


@pytest.mark.parametrize(("each", "times"), [("trial", 1), ("repeat", 3)])
def test_question_is_asked_once_per_trial_or_repeat(tmp_path: Path, each: str, times: int) -> None:
    operator, step = ScriptedOperator("7"), ask(f"{WIND}, each: {each}")
    views = [run_and_view(step, tmp_path / "trial" / "repeats" / name, operator) for name in ("b", ".a", "c")]
    assert len(operator.questions) == times
    assert [step.measure(view).values for view in views] == [{"wind": 7.0}] * 3
    run_and_view(step, tmp_path / "other" / "repeats" / "a", operator)
    assert len(operator.questions) == times + 1


@pytest.mark.parametrize("text", ["", "\n", "strong\n", "99\n", "3\n4\n"])
def test_invalid_answer_file_makes_repeat_void(tmp_path: Path, text: str) -> None:
    (tmp_path / "answer-wind.txt").write_text(text, encoding="utf-8")
    step, view = ask(WIND), View(SCENE, AttemptEvidence(tmp_path))
    assert list(step.check(view)) == ["answer-wind.txt has no valid answer of the operator"]
    assert step.measure(view).missing


def wait(text: str) -> WaitStep:
    return schema.validate(schema.parse(f"{{{text}}}", source="x.yaml"), WaitStep)


@pytest.mark.parametrize("text", ["", "duration: 1s, until: open the door", "duration: 0s", "until: ''"])
def test_wait_needs_either_a_duration_or_a_condition(text: str) -> None:
    with pytest.raises(ConfigurationError):
        wait(text)


def test_wait_ends_after_its_duration_or_when_the_operator_confirms() -> None:
    operator, testbed = ScriptedOperator(""), IdleTestbed()
    testbed.operator = operator
    wait("until: open the door").run(SCENE, testbed, ignore)
    assert operator.questions == ["open the door"]
    phases: list[tuple[str, float | None]] = []
    wait("duration: 1ms").run(SCENE, testbed, lambda *phase: phases.append(phase))
    assert phases == [("wait", 0.001)]
    assert list(wait("duration: 2s").dry_run_notes(SCENE)) == ["wait 2 s"]
