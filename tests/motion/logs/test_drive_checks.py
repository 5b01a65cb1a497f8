"""Changes in the log of a drive are detected by comparing fields with each other, the plan and the attempt."""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.agent.numbered_lines import NumberedLines
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Leg, Role, TrackPoint
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import track
from fieldkit.measure.positions import recorded_positions
from fieldkit.motion.logs import drive_checks, drive_log, motion_log
from fieldkit.motion.logs.drive_checks import DrivePlan
from tests.motion.logs.test_drive_log import drive

START_NS = 1_795_000_000_000_000_000
PLAN = DrivePlan((Leg(2.0, 0.0),), 1.0, (START_NS - 10**9, START_NS + 60 * 10**9))
FIELDS = ("utc_ns", "at_s", "phase", "x_m", "y_m", "forward_m_s", "driven_m", "ended")


def drive_lines() -> list[dict[str, Any]]:
    """Return lines of a robot that drives 2 m and returns."""
    entries = [*drive(4.0, 0.5, 1.0)]
    entries[-1] = {**entries[-1], "x_m": 0.0, "y_m": 0.0}
    return [{**line, "utc_ns": START_NS + round(1e9 * line["at_s"])} for line in entries]


def write_log(folder: Path, entries: list[dict[str, Any]], *, numbered: bool = True) -> Path:
    """Write lines in the format of the agent; without numbers, in the format of older versions."""
    text = StringIO()
    log = NumberedLines(text)
    for line in entries[:-1]:
        log.write(line)
    log.end(entries[-1])
    path = folder / drive_log.FILE
    path.write_text(
        text.getvalue() if numbered else "".join(f"{json.dumps(line)}\n" for line in entries), encoding="ascii"
    )
    return path


def reasons(path: Path) -> list[str]:
    log = drive_log.read(path)
    return [*filter(None, (motion_log.numbered_lines_problem(path),)), *drive_checks.contradictions(log, PLAN)]


@pytest.mark.parametrize("numbered", [True, False])
def test_an_unchanged_log_has_no_contradiction(numbered: bool, tmp_path: Path) -> None:
    path = write_log(tmp_path, drive_lines(), numbered=numbered)
    assert reasons(path) == []
    assert drive_log.measure(drive_log.read(path)).values["drive_farthest_m"] == pytest.approx(2.0)


@given(n_removed_bytes=st.integers(1, 2000))
def test_a_truncated_log_is_detected(n_removed_bytes: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = write_log(tmp_path_factory.mktemp("drive"), drive_lines())
    content = path.read_bytes()
    path.write_bytes(content[: max(len(content) - n_removed_bytes, 1)])
    try:
        assert reasons(path)
    except EvidenceError:
        return


def test_a_truncated_log_of_an_older_agent_is_detected(tmp_path: Path) -> None:
    path = write_log(tmp_path, drive_lines()[:40], numbered=False)
    assert reasons(path) == ["does not end at the starting position of the robot: it ends on the path"]


CHANGES: Mapping[str, Any] = {
    "an hour later": ({"utc_ns": 3600 * 10**9}, "before the attempt or after it"),
    "200 m away": ({"x_m": 200.0}, "differs from the driven distance"),
    "1 m longer": ({"driven_m": 1.0}, "differs from the driven distance"),
    "commanded speed too high": ({"forward_m_s": 5.0}, "a commanded speed is not between"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_line_is_detected(name: str, tmp_path: Path) -> None:
    change, expected_reason = CHANGES[name]
    entries = drive_lines()
    for field, increment in change.items():
        entries[45] = {**entries[45], field: entries[45][field] + increment}
    if "driven_m" in change:
        entries = [{**line, "driven_m": line["driven_m"] + (index > 45)} for index, line in enumerate(entries)]
    assert any(expected_reason in reason for reason in reasons(write_log(tmp_path, entries)))


def test_a_deviation_from_the_planned_path_is_detected(tmp_path: Path) -> None:
    entries = [{**line, "x_m": 3 * line["x_m"], "driven_m": 3 * line["driven_m"]} for line in drive_lines()]
    contradictions = reasons(write_log(tmp_path, entries))
    assert any("deviates by 4.0 m" in reason for reason in contradictions)
    assert any("drove at 3.00 m/s instead of 1 m/s" in reason for reason in contradictions)


@given(
    field=st.sampled_from(FIELDS[3:7]),
    changed_range=st.tuples(st.integers(0, 90), st.integers(1, 100)),
    increment=st.sampled_from([0.2, -0.2, 1.0, -1.0, 200.0, -200.0]),
)
def test_a_change_of_a_field_is_detected_or_hardly_changes_the_distances(
    field: str, changed_range: tuple[int, int], increment: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder, entries = tmp_path_factory.getbasetemp(), drive_lines()
    before = drive_log.measure(drive_log.read(write_log(folder, entries))).values
    for index in range(changed_range[0], min(changed_range[0] + changed_range[1], len(entries))):
        entries[index] = {**entries[index], field: entries[index][field] + increment}
    path = write_log(folder, entries)
    try:
        if reasons(path):
            return
    except EvidenceError:
        return
    for name, value in drive_log.measure(drive_log.read(path)).values.items():
        if isinstance(value, float):
            # Positions that were changed by up to 0.2 m can still agree with the driven distance.
            assert value == pytest.approx(before[name], abs=0.25), name


@given(removed=st.sets(st.integers(0, 80), min_size=1))
def test_missing_lines_are_detected(removed: set[int], tmp_path_factory: pytest.TempPathFactory) -> None:
    path = write_log(tmp_path_factory.mktemp("drive"), drive_lines())
    remaining = [
        line for index, line in enumerate(path.read_text("ascii").splitlines(keepends=True)) if index not in removed
    ]
    path.write_text("".join(remaining), encoding="ascii")
    assert reasons(path)


@given(position=st.integers(0), bit=st.integers(0, 6))
def test_any_flipped_bit_is_detected(position: int, bit: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = write_log(tmp_path_factory.mktemp("drive"), drive_lines())
    content = bytearray(path.read_bytes())
    content[position % len(content)] ^= 1 << bit
    path.write_bytes(content)
    try:
        assert motion_log.numbered_lines_problem(path) is not None
    except EvidenceError:
        return


def evidence_with_track(folder: Path, far_m: float) -> AttemptEvidence:
    """Return evidence with the testbed's track of a robot that drives away in 4 s, and returns."""
    track_points = [
        TrackPoint(START_NS + at_s * 10**9, Role.RECEIVER, (10 + far_m * x, 0, 0), (0, 0, 0))
        for at_s, x in ((0, 0), (4, 1), (9, 0))
    ]
    (folder / track.FILE).write_text(track.text(track_points), encoding="ascii")
    return AttemptEvidence(folder)


@pytest.mark.parametrize(("far_m", "agrees"), [(2.0, True), (2.1, True), (8.0, False), (0.0, False)])
def test_the_farthest_position_agrees_with_the_testbed(far_m: float, agrees: bool, tmp_path: Path) -> None:
    period_ns = (START_NS, START_NS + 9 * 10**9)
    reason = recorded_positions.travel_contradiction(
        evidence_with_track(tmp_path, far_m), Role.RECEIVER, 2.0, 0.5, period_ns
    )
    assert (reason is None) is agrees
    if reason:
        assert (
            reason
            == f"it was 2.0 m from its start according to its odometry, but {far_m:.1f} m according to track.csv"
        )


def test_the_deviation_at_a_corner_is_the_straight_line_distance() -> None:
    moment = drive_log.DriveMoment(0.0, "out", 3.0, 4.0, 0.0, 5.0, 0.0)
    (reason,) = [
        reason
        for reason in drive_checks.contradictions([replace(moment, ended="home")], PLAN)
        if "deviates by" in reason
    ]
    assert f"deviates by {math.hypot(1.0, 4.0):.1f} m" in reason
