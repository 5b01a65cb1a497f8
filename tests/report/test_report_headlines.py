"""Headlines: missing data is first, the worst condition precedes the best, and expected quantities precede others."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from fieldkit.analysis.cells import aggregate
from fieldkit.config import schema
from fieldkit.report.coverage import absences, everything_lost, total_absences
from fieldkit.report.headlines import Headline, Ranking, headlines
from fieldkit.report.trial_folders import Evidence, load_evidence
from fieldkit.steps.base import StepEntry
from fieldkit.steps.kinds.ping import PingStep
from fieldkit.steps.kinds.run import RunStep
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import plans, sources
from tests.helpers import lawns, recorded
from tests.helpers.tables import RepeatRow, parsed

FAR = {"scenario": "nlos", "procedure": "nlos", "distance": "60m", "distance_m": 60.0}
LOST = {"datagrams_received": 0, "datagram_loss": 1.0, "rtt_loss": 1.0, "rtt_median_s": None, "transfer_s": None}


def lines(rows: Sequence[RepeatRow], unmeasured: Sequence[str] = ()) -> dict[str, list[str]]:
    """Return the lines of each headline by its subject."""
    evidence = load_evidence(parsed(rows))
    result = headlines(aggregate(evidence.repeats), evidence, unmeasured)
    return {headline.subject: texts(headline) for headline in result}


def texts(headline: Headline) -> list[str]:
    lines = (filter(None, (end.extreme, end.value, end.interval, end.place)) for end in headline.lines)
    return [" ".join(parts).replace("\N{NO-BREAK SPACE}", " ") for parts in lines]


def test_condition_without_arrivals_precedes_the_largest_loss() -> None:
    near_rows = [lawns.row(number) for number in (1, 2)]
    middle_rows = [lawns.row(n, distance="90m", distance_m=90.0, rtt_median_s=0.05) for n in (1, 2)]
    lost_rows = [lawns.row(number, **FAR, **LOST) for number in (1, 2, 3)]
    lines_by_subject = lines([*near_rows, *middle_rows, *lost_rows])
    assert lines_by_subject["Repeats"] == ["7 of 7 valid", "nothing arrived in 3 repeats UDP, NLOS, 60m (3 of 3)"]
    assert lines_by_subject["UDP datagram loss"][0].startswith("most 100 % [43.")
    assert lines_by_subject["UDP datagram loss"][0].endswith("NLOS, 60m")
    assert lines_by_subject["UDP datagram loss"][1] == "least 5.56 % LOS, 10ft; LOS, 90m"
    assert lines_by_subject["RTT with UDP"] == [
        "nothing arrived NLOS, 60m (3 of 3)",
        "most 50.00 ms [50.00, 50.00]* LOS, 90m",
        "least 16.00 ms [16.00, 16.00]* LOS, 10ft",
    ]


def test_condition_with_total_loss_in_some_repeats_shows_their_number() -> None:
    rows = [lawns.row(1), lawns.row(2, **LOST), lawns.row(3, **LOST)]
    rows += [lawns.row(number, distance="20ft", distance_m=6.096) for number in (1, 2)]
    lines_by_subject = lines(rows)
    assert lines_by_subject["RTT with UDP"] == ["nothing arrived 10ft (2 of 3)", "in all others 16.00 ms"]
    assert lines_by_subject["Repeats"][1:] == ["nothing arrived in 2 repeats UDP, 10ft (2 of 3)"]


def test_void_failed_and_planned_conditions_are_counted() -> None:
    rows = [lawns.row(number) for number in (1, 2)]
    rows += [lawns.row(3, status="void", reason="no capture"), lawns.row(4, status="failed", reason="lost")]
    rows += [lawns.row(1, **FAR, status="failed", reason="no answer")]
    lines_by_subject = lines(rows, ["nlos 90m master"])
    assert lines_by_subject["Repeats"] == [
        "2 of 5 valid",
        "2 repeats failed UDP, NLOS, 60m (1 of 1); UDP, LOS, 10ft (1 of 4)",
        "1 repeat void UDP, LOS, 10ft (1 of 4)",
        "1 condition not run nlos 90m master",
    ]
    assert lines_by_subject["RTT with UDP"][0] == "no valid repeat NLOS, 60m (1 failed)"


def test_void_attempt_of_a_repeated_repeat_is_not_missing() -> None:
    second_row = lawns.row(1, attempt=2, started_utc_ns=1_795_262_500_000_000_000)
    assert lines([lawns.row(1, status="void", reason="no capture"), second_row])["Repeats"] == ["1 of 1 valid"]


def test_value_of_only_some_repeats_shows_their_number() -> None:
    rows = [lawns.row(1), lawns.row(2, rtt_median_s=None), lawns.row(3)]
    assert lines(rows)["RTT with UDP"] == ["no value 10ft (1 of 3)", "16.00 ms [16.00, 16.00]* (2 of 3) 10ft"]


def test_pings_of_different_sizes_have_separate_headlines() -> None:
    small_pings = [
        lawns.row(n, rtt_payload_bytes=56, rtt_median_s=0.001, distance="5m", distance_m=5.0) for n in (1, 2)
    ]
    large_pings = [lawns.row(n, rtt_payload_bytes=8192) for n in (1, 2)]
    lines_by_subject = lines([*small_pings, *large_pings])
    assert lines_by_subject["RTT with UDP, 56 bytes"] == ["1.00 ms [1.00, 1.00]* 5m"]
    assert lines_by_subject["RTT with UDP, 8192 bytes"] == ["16.00 ms [16.00, 16.00]* 10ft"]


@pytest.mark.parametrize(
    ("losses", "lost_rows"),
    [
        ({"datagram_loss": 1.0, "rtt_loss": 1.0}, True),
        ({"datagram_loss": 1.0, "rtt_loss": 0.9}, False),
        ({"datagram_loss": None, "rtt_loss": 1.0}, True),
        ({"datagram_loss": None, "rtt_loss": None}, False),
    ],
)
def test_everything_lost_if_all_losses_are_total(losses: dict[str, float | None], lost_rows: bool) -> None:
    assert everything_lost(parsed([lawns.row(1, **losses)])).tolist() == [lost_rows]


def test_quantity_without_its_own_loss_uses_the_other_losses() -> None:
    rows = [lawns.row(1), lawns.row(2, **(LOST | {"rtt_loss": None})), lawns.row(3, rtt_median_s=None)]
    values = lines(rows)["RTT with UDP"]
    assert values[:2] == ["nothing arrived 10ft (1 of 3)", "no value 10ft (1 of 3)"]


def test_condition_without_a_value_for_two_reasons_has_one_total_absence() -> None:
    rows = [lawns.row(1, **FAR, **LOST), lawns.row(2, **(FAR | {"rtt_median_s": None})), lawns.row(1)]
    evidence = load_evidence(parsed(rows))
    quantity = evidence.quantities["rtt_median_s"]
    cells = aggregate(evidence.repeats)
    assert [absence.text for absence in absences(cells, quantity, evidence)] == [
        "nothing arrived: 1 of 2",
        "no value: 1 of 2",
    ]
    (total,) = total_absences(cells, quantity, evidence)
    assert total.text == "nothing arrived or no value: 2 of 2"


def test_condition_with_some_values_has_no_total_absence() -> None:
    evidence = load_evidence(parsed([lawns.row(1), lawns.row(2, rtt_median_s=None)]))
    assert not list(total_absences(aggregate(evidence.repeats), evidence.quantities["rtt_median_s"], evidence))


def evidence_with(folder: Path, *expected: str) -> Evidence:
    """Return the evidence of a synthetic trial with expectations."""
    trial = recorded.make_plain(folder)
    plan = plans.read_plan(trial)
    procedure_with_expectations = plan.procedure.model_copy(update={"expect": expected})
    (trial / PLAN_FILE).write_text(
        schema.dump(plan.model_copy(update={"procedure": procedure_with_expectations})), encoding="utf-8"
    )
    return load_evidence(sources.find([trial], print).read())


def test_expected_quantities_are_first(tmp_path: Path) -> None:
    evidence = evidence_with(tmp_path, "ip_loss < 20 %")
    subjects = [headline.subject for headline in headlines(aggregate(evidence.repeats), evidence)]
    assert subjects[:2] == ["Repeats", "IP packet loss"]
    assert subjects.count("IP packet loss") == 1


def test_columns_of_named_steps_have_the_names_of_the_table(tmp_path: Path) -> None:
    evidence = evidence_with(tmp_path)
    plan = next(iter(evidence.plans.values()))
    figures = [{"name": "volts", "unit": "V", "json": "volts"}]
    steps = (
        StepEntry("ping", PingStep.model_validate({"name": "up", "from": "sender", "to": "receiver"})),
        StepEntry(
            "run",
            RunStep.model_validate({"name": "up", "robot": "sender", "command": "meter", "columns": figures}),
        ),
    )
    named_plan = plan.model_copy(update={"procedure": plan.procedure.model_copy(update={"steps": steps})})
    plans_by_source = dict.fromkeys(evidence.plans, named_plan)
    named_evidence = Evidence(evidence.repeats, plans_by_source, (), frozenset(), evidence.verified_sources)
    names = named_evidence.measured_columns(aggregate(evidence.repeats)[0])
    assert names is not None
    assert {"up.rtt_loss", "up.volts"} <= names
    assert "rtt_loss" not in names
    assert Ranking(named_evidence).is_user_defined("up.volts")


def test_planned_repeats_without_an_attempt_are_not_run(tmp_path: Path) -> None:
    evidence = evidence_with(tmp_path)
    plan = next(iter(evidence.plans.values()))
    assert plan.repeats == 1
    other_evidence = Evidence(
        evidence.repeats,
        {source: plan.model_copy(update={"repeats": 5}) for source in evidence.plans},
        (),
        frozenset(),
        evidence.verified_sources,
    )
    result = texts(next(iter(headlines(aggregate(evidence.repeats), other_evidence))))
    assert result[0] == "1 of 5 valid"
    assert any(line.startswith("4 repeats not run") for line in result)
