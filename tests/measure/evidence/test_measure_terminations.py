"""Recorded terminations of jobs on robots, and the terminations that are errors."""

from collections.abc import Collection

import pytest

from fieldkit.measure.evidence import terminations
from fieldkit.measure.evidence.terminations import Cause, Termination

RECORDED = """\
capture asked 0 1286133 12863.58
ping itself 0 1286162 12863.48
killed itself - 1285843 -
busy running - 1285843 -
send limit 130 1286154 12981.58
"""


def test_recorded_terminations_are_parsed() -> None:
    by_name = terminations.parse(RECORDED.splitlines())
    assert (by_name["capture"].cause, by_name["capture"].code) == (Cause.STOPPED, 0)
    assert by_name["capture"].duration_s == pytest.approx(2.25)
    assert by_name["killed"] == Termination(Cause.EXITED, None, None)
    assert [by_name[name].cause for name in ("ping", "busy", "send")] == [Cause.EXITED, Cause.RUNNING, Cause.LIMIT]


@pytest.mark.parametrize("line", ["", "capture", "a b 0 1 2.00", "ping itself 0 1 2.0 more", "x itself 9999 1 2.00"])
def test_other_lines_are_ignored(line: str) -> None:
    assert terminations.parse([line]) == {}


@pytest.mark.parametrize(
    ("line", "allowed_causes", "min_duration_s", "problem"),
    [
        ("job asked 0 100 9.00", {Cause.STOPPED}, 0.0, None),
        ("job itself 0 100 9.00", {Cause.STOPPED}, 0.0, "exited before fieldkit stopped it, with exit code 0"),
        ("job limit 0 100 9.00", {Cause.STOPPED}, 0.0, "did not exit, and was stopped at its time limit"),
        ("job itself 0 100 9.00", {Cause.EXITED}, 0.0, None),
        ("job itself 1 100 9.00", {Cause.EXITED}, 0.0, None),
        ("job itself 143 100 9.00", {Cause.EXITED, Cause.LIMIT}, 0.0, "was killed by SIGTERM, not by fieldkit"),
        ("job itself 137 100 9.00", {Cause.EXITED}, 0.0, "was killed by SIGKILL, not by fieldkit"),
        ("job itself 255 100 9.00", {Cause.EXITED}, 0.0, "was killed by signal 127, not by fieldkit"),
        ("job limit 130 100 9.00", {Cause.EXITED, Cause.LIMIT}, 0.0, None),
        ("job limit 137 100 9.00", {Cause.LIMIT}, 15.0, None),
        ("job asked 0 100 9.00", {Cause.EXITED}, 0.0, "was stopped by fieldkit before it had finished"),
        ("job itself 0 100 15.95", {Cause.EXITED}, 15.0, None),
        ("job itself 0 100 9.00", {Cause.EXITED}, 15.0, "exited after 8.0 s instead of 15 s"),
        ("job itself - 100 -", {Cause.EXITED}, 15.0, "was killed"),
        ("job running - 100 -", {Cause.EXITED}, 0.0, "was still running when the evidence was collected"),
        ("job running 0 100 9.00", {Cause.EXITED}, 0.0, "was still running when the evidence was collected"),
    ],
)
def test_a_termination_that_is_not_allowed_is_an_error(
    line: str, allowed_causes: Collection[Cause], min_duration_s: float, problem: str | None
) -> None:
    assert (
        terminations.termination_error(terminations.parse([line])["job"], allowed_causes, min_duration_s) == problem
    )
