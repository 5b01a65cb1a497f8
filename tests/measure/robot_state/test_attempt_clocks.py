"""Clocks of an attempt: columns, marks, contradictions with measured offsets, and reasons for withheld delays."""

from pathlib import Path

import pytest

from fieldkit.core.columns import Measured, cell_text
from fieldkit.core.model import Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence.clock import Clock
from fieldkit.measure.robot_state import attempt_states, exchanges
from fieldkit.measure.robot_state.state_columns import MARK_COLUMNS, declare_columns

NAMES = {Role.SENDER: "robot-1", Role.RECEIVER: "robot-2"}
SYNCHRONIZED = "0A090002,10.9.0.2,2,1795950534.1,-0.000002537,0,0,-0.03,0.00,0.2,0.000400000,0.000100000,0.5,Normal"
SLOW = SYNCHRONIZED.replace("-0.000002537", "1.500000000")
NO_SOURCE = "00000000,,0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,1.0,1.0,0.0,Not synchronised"
BOOT_S = 1_700_000_000


def write(folder: Path, role: Role, *reports: str, offset_s: float = 0.0) -> None:
    """Write snapshots of a robot, and its state with a clock that is `offset_s` ahead of the laptop."""
    for snapshot, report in zip(("before", "after"), reports, strict=False):
        text = f"==> chrony <==\n {report}\n \n code 0\n"
        (folder / f"{role}-sources-{snapshot}.txt").write_text(text, encoding="ascii")
    clock = f"100.00 {BOOT_S + 100 + offset_s:.9f} 100.00\n"
    (folder / f"{role}-before.txt").write_text(f"==> clock <==\n{clock}", encoding="ascii")


def measure(folder: Path, **values: float | str) -> Measured:
    times = dict.fromkeys(NAMES, ((BOOT_S + 100) * 10**9 - 20000000, (BOOT_S + 100) * 10**9 + 20000000))
    (folder / exchanges.FILE).write_text(exchanges.text(times), encoding="ascii")
    measured = attempt_states.measure(AttemptEvidence(folder), NAMES, Measured(values))
    declared_columns = (*MARK_COLUMNS, *(column for role in NAMES for column in declare_columns(role)))
    for column in declared_columns:
        assert (column.name in measured.values) != (column.name in measured.missing), column.name
        assert column.invalid_value_reason(cell_text(measured.values.get(column.name))) is None
    return measured


def test_synchronized_clocks_give_columns_and_no_mark(tmp_path: Path) -> None:
    write(tmp_path, Role.SENDER, SYNCHRONIZED, SYNCHRONIZED.replace("-0.000002537", "0.000300000"))
    write(tmp_path, Role.RECEIVER, SYNCHRONIZED, SYNCHRONIZED)
    measured = measure(tmp_path, clock_offset_s=0.0004, clock_offset_error_s=0.0005)
    assert measured.values["marks"] == "none"
    assert measured.values["sender_time_source"] == "chrony 10.9.0.2"
    assert measured.values["sender_time_offset_s"] == -0.0003, "the larger of the offsets before and after"
    assert measured.values["sender_time_error_s"] == pytest.approx(0.0003)
    assert measured.values["receiver_time_offset_s"] == 2.537e-6
    assert measured.values["receiver_laptop_offset_s"] == pytest.approx(0.0, abs=0.005)
    assert measured.values["receiver_laptop_offset_error_s"] == pytest.approx(0.02, abs=0.005)


def test_a_wrong_clock_without_a_source_is_the_reason_for_a_withheld_delay(tmp_path: Path) -> None:
    write(tmp_path, Role.SENDER, SYNCHRONIZED, SYNCHRONIZED)
    write(tmp_path, Role.RECEIVER, NO_SOURCE, NO_SOURCE, offset_s=1.0)
    withheld = "no packet from receiver to sender is in both captures"
    measured = measure(tmp_path, one_way_withheld=withheld)
    sentence = "robot-2 is off by 1.0 s, chrony has no source"
    assert measured.values["one_way_withheld"] == f"{withheld}; {sentence}"
    assert (measured.values["marks"], measured.values["marks_reason"]) == ("wrong clock", sentence)
    assert measured.missing["receiver_time_offset_s"] == "chrony has no source", (
        "0, which chrony prints, is not the offset"
    )
    # Delays with a measured offset are withheld for another reason.
    measured_offset = {"clock_offset_s": 1.0, "clock_offset_error_s": 0.001}
    assert (
        measure(tmp_path, one_way_withheld="its error", **measured_offset).values["one_way_withheld"] == "its error"
    )


def test_a_clock_that_is_being_corrected_is_wrong(tmp_path: Path) -> None:
    write(tmp_path, Role.SENDER, SYNCHRONIZED, SYNCHRONIZED)
    write(tmp_path, Role.RECEIVER, SLOW, SYNCHRONIZED)
    measured = measure(tmp_path, clock_offset_s=-1.5, clock_offset_error_s=0.001)
    assert measured.values["marks"] == "wrong clock"
    assert measured.values["marks_reason"] == "robot-2 is off by 1.5 s, although chrony has the source 10.9.0.2"


def test_a_source_that_is_lost_during_the_repeat_is_missing(tmp_path: Path) -> None:
    write(tmp_path, Role.SENDER, SYNCHRONIZED, NO_SOURCE)
    write(tmp_path, Role.RECEIVER, SYNCHRONIZED, SYNCHRONIZED)
    measured = measure(tmp_path)
    assert measured.values["marks"] == "no time source"
    assert "sender_time_offset_s" not in measured.values


@pytest.mark.parametrize(("offset_s", "is_contradiction"), [(0.0015, False), (0.5, True), (-0.5, True)])
def test_measured_offsets_are_compared_with_the_reports(
    tmp_path: Path, offset_s: float, is_contradiction: bool
) -> None:
    for role in NAMES:
        write(tmp_path, role, SYNCHRONIZED, SYNCHRONIZED)
    values = {"up.clock_offset_s": offset_s, "up.clock_offset_error_s": 0.0002}
    measured = measure(tmp_path, **values)
    assert (measured.values["marks"] == "clocks disagree") is is_contradiction
    if is_contradiction:
        assert measured.values["marks_reason"] == (
            f"the clocks of robot-1 and robot-2 differ by {offset_s:+.3f} s (error 0.000 s), but chrony reports "
            "+0.000 s (error 0.001 s)"
        )


def test_robots_without_sources_have_no_marks(tmp_path: Path) -> None:
    for role in NAMES:
        write(tmp_path, role)
    measured = measure(tmp_path)
    assert "marks" not in measured.values
    assert measured.missing["sender_time_source"] == "no program of the robot reports it"


def test_an_exchange_bounds_the_offset_of_a_clock_unless_it_was_set() -> None:
    steady_clock = Clock(first_ns=1_000, last_ns=1_010, lowest_ns=0, highest_ns=0)
    measured = exchanges.offset(900, 1_200, steady_clock)
    assert measured is not None
    assert (round(measured.offset_s * 1e9), round(measured.error_s * 1e9)) == (-45, 145)
    assert exchanges.offset(900, 1_200, Clock(1_000, 2_000, 0, 0)) is None


def test_other_lines_in_the_file_of_exchanges_are_ignored(tmp_path: Path) -> None:
    (tmp_path / exchanges.FILE).write_text("sender 1 2\nreceiver 1\nA 1 2\n\nrelay 9 99999999999999999999\n")
    assert exchanges.read(tmp_path / exchanges.FILE) == {Role.SENDER: (1, 2)}
