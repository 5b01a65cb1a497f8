"""Columns of the log of a flight on a given path, and invalid lines."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as d

from fieldkit.agent.autopilots.autopilot import AutopilotState
from fieldkit.agent.flying.flight_log import FlightLog
from fieldkit.agent.flying.origin import FlightOrigin
from fieldkit.core.errors import EvidenceError
from fieldkit.motion.logs import fly_log
from fieldkit.motion.logs.fly_log import FlightMoment
from tests.agent.test_agent_flight import state_from

NAMES = {column.name for column in fly_log.COLUMNS}
START_M = (10.0, -4.0, -1.5)
LINE = {
    "utc_ns": 1,
    "at_s": 0.0,
    "phase": "flying",
    "ahead_m": 0.0,
    "left_m": 0.0,
    "up_m": 0.0,
    "speed_m_s": 0.0,
}


def write_log(folder: Path, lines: list[dict[str, Any]], end: str = "") -> Path:
    path = folder / fly_log.FILE
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines) + end, encoding="ascii")
    return path


def state_at(position_m: tuple[float, float, float] | None, speed_m_s: float) -> AutopilotState:
    """Return the state of an autopilot that has reported this position and speed."""
    if position_m is None:
        return state_from()[0]
    return state_from(d.MAVLink_local_position_ned_message(1, *position_m, speed_m_s, 0.0, 0.0))[0]


def write_flight(path: Path, yaw_rad: float) -> None:
    """Write the log of a drone that climbs 3 m, flies 4 m ahead and 3 m left, and lands 0.5 m from the start."""
    log = FlightLog(str(path))
    autopilot = state_at(START_M, 0.0)
    log.note(autopilot)
    log.begin(FlightOrigin("local", "", *START_M[:2], yaw_rad), START_M[2])
    phases = [("standing", 0.0, 0.0, 0.0, 0.0), ("climbing", 0.0, 0.0, 1.0, 1.0), ("up", 0.0, 0.0, 3.1, 0.1)]
    phases += [("flying", 4 * tenth / 10, 3 * tenth / 10, 3.0, 2.0) for tenth in range(11)]
    phases += [("there", 4, 3, 3.0, 0.0)] * 5 + [
        ("coming back", 2, 1, 3.0, 2.5),
        ("coming down", 0.3, 0.4, -0.1, 0.2),
    ]
    for phase, ahead_m, left_m, up_m, speed_m_s in phases:
        log.phase = phase
        north_m = ahead_m * math.cos(yaw_rad) + left_m * math.sin(yaw_rad)
        east_m = ahead_m * math.sin(yaw_rad) - left_m * math.cos(yaw_rad)
        log.note(state_at((START_M[0] + north_m, START_M[1] + east_m, START_M[2] - up_m), speed_m_s))
        log.note(state_at(None, 0.0))


@pytest.mark.parametrize("yaw_rad", [0.0, 2.0, -3.0])
def test_the_columns_of_a_given_flight(tmp_path: Path, yaw_rad: float) -> None:
    write_flight(tmp_path / fly_log.FILE, yaw_rad)
    log = fly_log.read(tmp_path / fly_log.FILE)
    assert len(log) == 21, "no line is written before the origin is set and while the position is unknown"
    assert (log[13].ahead_m, log[13].left_m) == pytest.approx((4.0, 3.0), abs=1e-3)
    measured = fly_log.measure(log)
    assert not measured.missing
    assert measured.values == pytest.approx(
        {
            "fly_height_median_m": 3.0,
            "fly_height_max_m": 3.1,
            "fly_farthest_m": 5.0,
            "fly_speed_median_m_s": 2.0,
            "fly_speed_max_m_s": 2.5,
            "fly_back_off_m": 0.5,
        },
        abs=1e-3,
    )


def test_unknown_values_are_missing_with_a_reason(tmp_path: Path) -> None:
    assert fly_log.measure(None).missing.keys() == NAMES
    log = write_log(tmp_path, [{**LINE, "phase": "up"}], end='{"utc_ns": 1')
    measured = fly_log.measure(fly_log.read(log))
    assert measured.missing.keys() == {"fly_height_median_m", "fly_speed_median_m_s", "fly_back_off_m"}


@pytest.mark.parametrize("path", ["/dev/full", "/nowhere/fly.jsonl", ""])
def test_a_flight_continues_if_its_log_cannot_be_written(path: str) -> None:
    log = FlightLog(path)
    log.begin(FlightOrigin("local", "", *START_M[:2], 0.0), START_M[2])
    log.phase = "flying"
    for _ in range(3):
        log.note(state_at(START_M, 1.0))


@pytest.mark.parametrize(
    "invalid_fields",
    [
        {"ahead_m": None},
        {"ahead_m": math.nan},
        {"left_m": math.inf},
        {"up_m": 10**400},
        {"up_m": -1e7},
        {"at_s": -1.0},
        {"speed_m_s": -0.1},
        {"speed_m_s": math.nan},
        {"phase": "lost"},
        {"phase": ["flying"]},
    ],
)
def test_an_invalid_line_is_refused(tmp_path: Path, invalid_fields: dict[str, Any]) -> None:
    with pytest.raises(EvidenceError, match="line 2 is not a line of a flight log"):
        fly_log.read(write_log(tmp_path, [LINE, {**LINE, **invalid_fields}]))


def test_a_missing_or_empty_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="contains no position of a"):
        fly_log.read(write_log(tmp_path, []))
    with pytest.raises(EvidenceError, match="not in chronological order"):
        fly_log.read(write_log(tmp_path, [{**LINE, "at_s": 1.0}, LINE]))
    with pytest.raises(EvidenceError, match="cannot be read"):
        fly_log.read(tmp_path / "none")


numbers = st.floats(-1e6, 1e6)
moments = st.builds(
    FlightMoment,
    at_s=st.just(0.0),
    phase=st.sampled_from(["standing", "flying", "there", "coming down"]),
    ahead_m=numbers,
    left_m=numbers,
    up_m=numbers,
    speed_m_s=st.floats(0, 1e4),
)


@given(st.lists(moments, max_size=6))
def test_the_columns_of_any_log_are_possible(log: list[FlightMoment]) -> None:
    measured = fly_log.measure(log)
    assert measured.values.keys() | measured.missing.keys() == NAMES
    for column in fly_log.COLUMNS:
        if column.name in measured.values:
            assert column.invalid_value_reason(str(measured.values[column.name])) is None
