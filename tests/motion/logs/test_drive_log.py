"""Columns of the log of a drive on a given path, and invalid lines."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.motion.logs import drive_log

NAMES = {column.name for column in drive_log.COLUMNS}
LINE = {
    "utc_ns": 1,
    "at_s": 0.0,
    "phase": "out",
    "x_m": 0.0,
    "y_m": 0.0,
    "yaw_rad": 0.0,
    "forward_m_s": 0.0,
    "turn_rad_s": 0.0,
    "driven_m": 0.0,
    "left_m": 1.0,
    "ended": "",
}


def drive(out_s: float, speed_m_s: float, return_m_s: float) -> Iterator[dict[str, Any]]:
    """Yield lines of a robot that waits 2 s, drives straight, stops for 1 s, and returns with an error of 5 cm."""
    yield from ({**LINE, "at_s": tenth / 10} for tenth in range(20))
    for tenth in range(round(10 * out_s) + 1):
        at_s = tenth / 10
        fields = {"x_m": speed_m_s * at_s, "driven_m": speed_m_s * at_s, "forward_m_s": speed_m_s}
        yield {**LINE, "at_s": 2 + at_s, **fields}
    distance_m = speed_m_s * out_s
    for tenth in range(1, 11):
        yield {**LINE, "at_s": 2 + out_s + tenth / 10, "x_m": distance_m, "driven_m": distance_m, "phase": "there"}
    return_s = distance_m / return_m_s
    for tenth in range(round(10 * return_s) + 1):
        returned_m = return_m_s * tenth / 10
        fields = {"x_m": distance_m - returned_m, "driven_m": distance_m + returned_m, "forward_m_s": return_m_s}
        yield {**LINE, "at_s": 3 + out_s + tenth / 10, "phase": "back", **fields}
    at_s = 3 + out_s + return_s
    end = {"x_m": 0.03, "y_m": -0.04, "yaw_rad": 0.2, "phase": "home", "ended": "home"}
    yield {**LINE, "at_s": at_s, "driven_m": 2 * distance_m, **end}


def write_log(folder: Path, lines: list[dict[str, Any]], end: str = "") -> Path:
    path = folder / drive_log.FILE
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines) + end, encoding="ascii")
    return path


def test_the_columns_of_a_given_path(tmp_path: Path) -> None:
    log = drive_log.read(write_log(tmp_path, list(drive(4.0, 0.5, 1.0))))
    measured = drive_log.measure(log)
    assert not measured.missing
    assert measured.values["drive_ended"] == "home"
    del measured.values["drive_ended"]  # type: ignore[attr-defined]
    assert measured.values == pytest.approx(
        {
            "drive_out_m": 2.0,
            "drive_farthest_m": 2.0,
            "drive_speed_median_m_s": 0.5,
            "drive_speed_max_m_s": 1.0,
            "drive_back_off_m": 0.05,
            "drive_back_turned_rad": 0.2,
        }
    )


def test_unknown_values_are_missing_with_a_reason(tmp_path: Path) -> None:
    assert drive_log.measure(None).missing.keys() == NAMES
    # An interrupted drive: the last line is incomplete, and no line has the end.
    lines = [line for line in drive(1.0, 0.5, 1.0) if line["phase"] == "out"]
    measured = drive_log.measure(drive_log.read(write_log(tmp_path, lines, end='{"utc_ns": 1')))
    assert measured.missing.keys() == {"drive_back_off_m", "drive_back_turned_rad", "drive_ended"}
    assert measured.values["drive_out_m"] == 0.5
    measured_short = drive_log.measure(drive_log.read(write_log(tmp_path, lines[:22])))
    assert "drive_speed_median_m_s" in measured_short.missing


def test_control_characters_in_the_reason_for_the_end_are_replaced(tmp_path: Path) -> None:
    lines = [LINE, {**LINE, "at_s": 1.0, "ended": "odometry\x1b[2J was silent" + "!" * 999}]
    measured = drive_log.measure(drive_log.read(write_log(tmp_path, lines)))
    log_lines = str(measured.values["drive_ended"])
    assert log_lines.startswith("odometry?[2J was silent!")
    assert len(log_lines) == 200
    assert "drive_back_off_m" in measured.missing


@pytest.mark.parametrize(
    "invalid_fields",
    [
        {"x_m": None},
        {"x_m": math.nan},
        {"y_m": math.inf},
        {"y_m": 10**400},
        {"yaw_rad": 4.0},
        {"at_s": -1.0},
        {"driven_m": -0.1},
        {"driven_m": 1e7},
        {"forward_m_s": math.nan},
        {"phase": "lost"},
        {"phase": ["out"]},
        {"ended": 3},
    ],
)
def test_an_invalid_line_is_refused(tmp_path: Path, invalid_fields: dict[str, Any]) -> None:
    with pytest.raises(EvidenceError, match="line 2 is not a line of a drive log"):
        drive_log.read(write_log(tmp_path, [LINE, {**LINE, **invalid_fields}]))


def test_a_missing_or_empty_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="contains no position of a"):
        drive_log.read(write_log(tmp_path, []))
    with pytest.raises(EvidenceError, match="not in chronological order"):
        drive_log.read(write_log(tmp_path, [{**LINE, "at_s": 1.0}, LINE]))
    with pytest.raises(EvidenceError, match="cannot be read"):
        drive_log.read(tmp_path / "none")
    with pytest.raises(EvidenceError, match="line 1"):
        drive_log.read(write_log(tmp_path, [], end="[1]\n"))


@pytest.mark.parametrize("phase", ["waits", "returns"])
def test_a_drive_that_ends_before_the_path_has_its_reason(tmp_path: Path, phase: str) -> None:
    log = drive_log.read(write_log(tmp_path, [{**LINE, "phase": phase, "ended": "ordered to stop"}]))
    measured = drive_log.measure(log)
    assert measured.values["drive_ended"] == "ordered to stop"
    assert "drive_out_m" in measured.missing


any_numbers = st.floats(allow_nan=True, allow_infinity=True) | st.integers() | st.none() | st.text(max_size=3)
NUMBERS = ("at_s", "x_m", "y_m", "yaw_rad", "driven_m", "forward_m_s")
lines = st.fixed_dictionaries(
    {
        **{name: st.sampled_from([0.0, 0.5]) | any_numbers for name in NUMBERS},
        "phase": st.sampled_from(["out", "there", "back", "home", "else"]),
        "ended": st.sampled_from(["", "home"]) | st.text(max_size=5),
    }
)


@given(st.lists(lines | st.just(LINE), max_size=4), st.binary(max_size=20))
def test_any_log_is_refused_or_gives_possible_values(
    tmp_path_factory: pytest.TempPathFactory, log_lines: list[dict[str, Any]], end: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / drive_log.FILE
    path.write_bytes("".join(f"{json.dumps(line)}\n" for line in log_lines).encode() + end)
    try:
        measured = drive_log.measure(drive_log.read(path))
    except EvidenceError:
        return
    assert measured.values.keys() | measured.missing.keys() == NAMES
    for column in drive_log.COLUMNS:
        if column.name in measured.values:
            value = measured.values[column.name]
            assert isinstance(value, column.type)
            assert column.invalid_value_reason(str(value)) is None
