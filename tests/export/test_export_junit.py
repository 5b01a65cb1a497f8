"""JUnit XML of trials."""

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from fieldkit.cli import main
from fieldkit.export import junit
from fieldkit.trial import store
from fieldkit.trial.journal import JOURNAL_FILE
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.stored import plans
from tests.helpers.stored_trials import TRIALS

pytestmark = pytest.mark.ros  # the stored trial records bags

LOSSY = next(TRIALS.glob("20261122T013134*"))


@pytest.fixture
def trial(tmp_path: Path) -> Path:
    return Path(shutil.copytree(LOSSY, tmp_path / LOSSY.name))


def suite(*folders: Path) -> ET.Element:
    (element,) = ET.fromstring(junit.text(folders))
    return element


def names_of_cases(element: ET.Element, kind: str) -> list[str]:
    return [str(case.get("name")) for case in element if case.find(kind) is not None]


def edit_file(path: Path, edit: Callable[[str], str]) -> None:
    before = path.read_text(encoding="utf-8")
    after = edit(before)
    assert after != before
    path.write_text(after, encoding="utf-8")


def test_each_repeat_is_a_case_with_its_time(trial: Path) -> None:
    element, plan = suite(trial), plans.read_plan(trial)
    assert [case.get("name") for case in element] == [str(repeat) for repeat in plan.repeats_in_order()]
    assert element.get("tests") == str(len(element))
    assert element.get("failures") == element.get("skipped") == "0"
    assert {case.get("classname") for case in element} == {"fieldkit.los.30ft.master"}
    assert all(0 < float(case.get("time", "")) < 1000 for case in element)


def test_a_failed_repeat_is_a_failure_with_its_reason(trial: Path) -> None:
    def fail(text: str) -> str:
        lines = text.splitlines(keepends=True)
        return "".join(
            [*lines[:-1], lines[-1].replace('"valid"', '"failed"').replace('"reason": ""', '"reason": "a<b"')]
        )

    edit_file(trial / JOURNAL_FILE, fail)
    element = suite(trial)
    (name,) = names_of_cases(element, "failure")
    assert element.get("failures") == "1"
    assert name == str(list(plans.read_plan(trial).repeats_in_order())[-1])


def test_a_repeat_that_has_not_ended_is_a_skipped_case(trial: Path) -> None:
    edit_file(trial / JOURNAL_FILE, lambda text: "".join(text.splitlines(keepends=True)[:-1]))
    assert len(names_of_cases(suite(trial), "skipped")) == 1


def test_an_expectation_is_a_case_that_fails_unless_it_holds(trial: Path) -> None:
    expect = "  expect: [rtt_median_s > 1 us, rtt_median_s < 1 us]\n"
    edit_file(trial / PLAN_FILE, lambda text: text.replace("  steps:\n", f"{expect}  steps:\n", 1))
    element = suite(trial)
    failed_cases = names_of_cases(element, "failure")
    protocols = [str(protocol).upper() for protocol in plans.read_plan(trial).protocols]
    assert failed_cases == [f"rtt_median_s < 1 us ({protocol})" for protocol in protocols]
    assert element.get("tests") == str(len(element))


def add_expectations(trial: Path, *expect: str) -> None:
    text = ", ".join(expect)
    edit_file(trial / PLAN_FILE, lambda plan: plan.replace("  steps:\n", f"  expect: [{text}]\n  steps:\n", 1))


def set_column(trial: Path, name: str, values: Callable[[int], str]) -> None:
    """Add a column to the table of the trial, or replace the values of a column."""
    path = trial / store.TRIAL_CSV
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row | {name: values(number)} for number, row in enumerate(csv.DictReader(file))]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def test_an_expectation_on_repeats_without_a_value_is_a_failure_that_counts_them(trial: Path) -> None:
    add_expectations(trial, "udp rtt_median_s < 10 s")
    set_column(trial, "rtt_median_sent_s", lambda number: "0.01")
    assert not names_of_cases(suite(trial), "failure")
    set_column(trial, "rtt_median_s", lambda number: "" if number % 4 == 1 else "0.01")
    (failure,) = suite(trial).iter("failure")
    assert failure.get("message") == (
        "undecided: no value in 1 of 2 repeats; a single repeat has no interval: 10.00 ms (1 of 2)"
    )


def test_a_trial_without_its_table_passes_no_expectation(trial: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add_expectations(trial, "rtt_loss < 100 %")
    assert not names_of_cases(suite(trial), "failure")
    (trial / store.TRIAL_CSV).unlink()
    out = trial.parent / "results.xml"
    assert main(["export", str(trial.parent), "--format", "junit", "-o", str(out)]) == 0
    (element,) = ET.parse(out).getroot()
    assert names_of_cases(element, "failure") == ["rtt_loss < 100 %"]
    assert "no repeat has ended" in capsys.readouterr().err + out.read_text(encoding="utf-8")


def test_the_command_writes_valid_xml(trial: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = trial.parent / "results.xml"
    assert main(["export", str(trial.parent), "--format", "junit", "-o", str(out)]) == 0
    assert "wrote" in capsys.readouterr().out
    (element,) = ET.parse(out).getroot()
    assert element.get("name") == trial.name


def test_no_text_from_a_robot_breaks_the_file(trial: Path) -> None:
    reason = "\\u0000\\u001b[31m]]>&<\\ud800\\uffff"
    edit_file(trial / JOURNAL_FILE, lambda text: text.replace('"reason": ""', f'"reason": "{reason}"', 3))
    assert len(suite(trial)) > 0
