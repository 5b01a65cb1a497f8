"""A change in the log of a flight is detected, or changes figures by less than the position error."""

import math
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.numbered_lines import NumberedLines
from fieldkit.core.errors import EvidenceError
from fieldkit.motion.logs import fly_checks, fly_log, motion_log
from fieldkit.motion.logs.fly_checks import POSITION_ERROR_M, FlyPlan

START_NS = 1_795_000_000_000_000_000
PLAN = FlyPlan(3.0, 20.0, 3.0, (START_NS - 10**9, START_NS + 60 * 10**9))


def flight_lines() -> list[dict[str, Any]]:
    """Return lines of a drone that climbs to 3 m in 3 s, flies 20 m away in 10 s, and lands there in 5 s."""
    entries = []
    for tenth in range(201):
        at_s = tenth / 10
        phase = next(name for name, end_s in PHASES if at_s <= end_s)
        up_m = min(at_s, 3.0) if at_s < 14 else max(3.0 - (at_s - 14) * 0.6, 0.0)
        entries.append(
            {
                "utc_ns": START_NS + round(1e9 * at_s),
                "at_s": at_s,
                "phase": phase,
                "ahead_m": min(max(at_s - 4, 0.0) * 2, 20.0),
                "left_m": 0.0,
                "up_m": up_m,
                "speed_m_s": 2.0 if 4 <= at_s <= 14 else 1.0,
            }
        )
    return entries


PHASES = (("standing", 0.5), ("climbing", 3.0), ("up", 4.0), ("flying", 14.0), ("there", 14.5), ("coming down", 20.0))


def write_log(folder: Path, entries: list[dict[str, Any]], *, has_end: bool = True) -> Path:
    text = StringIO()
    log = NumberedLines(text)
    for line in entries:
        log.write(line)
    if has_end:
        log.end({"utc_ns": START_NS + 21 * 10**9, "ended": "landed"})
    path = folder / fly_log.FILE
    path.write_text(text.getvalue(), encoding="ascii")
    return path


def reasons(path: Path) -> list[str]:
    log = fly_log.read(path)
    return [*filter(None, (motion_log.numbered_lines_problem(path),)), *fly_checks.contradictions(log, PLAN)]


def test_an_unchanged_log_has_no_contradiction(tmp_path: Path) -> None:
    assert reasons(write_log(tmp_path, flight_lines())) == []


def test_a_log_without_its_end_is_detected(tmp_path: Path) -> None:
    assert reasons(write_log(tmp_path, flight_lines(), has_end=False)) == [
        "its last line is missing: its writer was killed"
    ]
    reasons_of_short_log = reasons(write_log(tmp_path, flight_lines()[:90]))
    assert reasons_of_short_log == ["ends while the drone was flying, not coming down"]


@pytest.mark.parametrize(
    ("field", "increment", "expected_reason"),
    [
        ("ahead_m", 200.0, "two consecutive positions are farther apart"),
        ("up_m", 50.0, "two consecutive positions are farther apart"),
        ("speed_m_s", 60.0, "the drone flew at 62.0 m/s, but its limit is 3 m/s"),
        ("utc_ns", 3600 * 10**9, "from before the attempt or after it"),
        ("at_s", 0.05, ""),
    ],
)
def test_a_changed_line_is_detected(field: str, increment: float, expected_reason: str, tmp_path: Path) -> None:
    entries = flight_lines()
    entries[80] = {**entries[80], field: entries[80][field] + increment}
    contradictions = reasons(write_log(tmp_path, entries))
    assert any(expected_reason in reason for reason in contradictions) if expected_reason else contradictions == []


@given(
    field=st.sampled_from(["ahead_m", "left_m", "up_m", "speed_m_s"]),
    changed_range=st.tuples(st.integers(0, 200), st.integers(1, 200)),
    increment=st.sampled_from([1.0, -1.0, 7.0, 30.0, -30.0, 200.0, -200.0]),
)
def test_any_change_of_a_field_is_detected(
    field: str, changed_range: tuple[int, int], increment: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder, entries = tmp_path_factory.getbasetemp(), flight_lines()
    before = fly_log.measure(fly_log.read(write_log(folder, entries))).values
    for index in range(changed_range[0], min(sum(changed_range), len(entries))):
        entries[index] = {**entries[index], field: entries[index][field] + increment}
    path = write_log(folder, entries)
    try:
        if reasons(path):
            return
    except EvidenceError:
        return
    for name, value in fly_log.measure(fly_log.read(path)).values.items():
        assert value == pytest.approx(before[name], abs=POSITION_ERROR_M + 2.0), name


def test_telemetry_of_another_flight_is_detected(tmp_path: Path) -> None:
    log = fly_log.read(write_log(tmp_path, flight_lines()))
    reported_m = np.array([(moment.ahead_m, moment.left_m, moment.up_m) for moment in log])
    rotated_m = reported_m @ np.array(
        [[math.cos(0.7), -math.sin(0.7), 0], [math.sin(0.7), math.cos(0.7), 0], [0, 0, 1]]
    )
    assert fly_checks.telemetry_contradiction(log, rotated_m + 300.0) is None
    assert fly_checks.telemetry_contradiction(log, np.empty((0, 3))) is None
    assert "over the ground" in (fly_checks.telemetry_contradiction(log, 3 * reported_m) or "")
    assert "in height" in (fly_checks.telemetry_contradiction(log, reported_m * [1, 1, 5]) or "")
