"""Outages of robots from files that are written by hand in the format of the observer."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind
from fieldkit.measure.evidence import outage
from fieldkit.measure.evidence.outage import Recovery
from tests.helpers.measures import measure

HEADER = "PING 10.42.0.1 (10.42.0.1) 56(84) bytes of data."
FIRST_S = 1_795_218_000


def pings(answered_numbers: list[int], n_sent: int, *, stamps: bool = True, interval_s: float = 0.1) -> str:
    """Return output of ping for `n_sent` requests. Only the requests in `answered_numbers` have an answer."""
    lines = [HEADER]
    for number in answered_numbers:
        stamp = f"[{FIRST_S + number * interval_s:.6f}] " if stamps else ""
        lines.append(f"{stamp}64 bytes from 10.42.0.1: icmp_seq={number} ttl=64 time=0.6 ms")
    return "\n".join([*lines, "", "--- 10.42.0.1 ping statistics ---", summary(n_sent, len(answered_numbers))])


def summary(n_sent: int, n_received: int) -> str:
    return f"{n_sent} packets transmitted, {n_received} received, 1% packet loss, time 6066ms"


def watch_output(*polls: tuple[float, str]) -> str:
    return "\n".join(["watching nc", *(f"{at_s:.2f}{f' up {pids}' if pids else ''}" for at_s, pids in polls), ""])


def write_fault(
    path: Path, kind: FaultKind, text: str, duration_text: str = "2.000", interval_text: str = "0.1"
) -> Path:
    name = "watch" if kind is FaultKind.KILL else "ping"
    (path / f"fault-{kind}-{name}.txt").write_text(text, encoding="utf-8")
    (path / f"fault-{kind}.txt").write_text(
        f"lasted_s {duration_text}\ninterval_s {interval_text}\n", encoding="utf-8"
    )
    return path


WITH_GAP = [*range(1, 11), *range(36, 50)]
"""The 25 requests from 11 to 35 have no answer: 2.6 s between two answers."""


@pytest.mark.parametrize("stamps", [True, False])
def test_the_outage_is_the_longest_gap_and_the_recovery_is_the_part_after_the_fault(
    tmp_path: Path, stamps: bool
) -> None:
    result = outage.read(
        write_fault(tmp_path, FaultKind.LINK_DOWN, pings(WITH_GAP, 49, stamps=stamps)), FaultKind.LINK_DOWN
    )
    assert result.recovered
    assert result.outage_s == pytest.approx(2.6)
    assert result.recovery_s == pytest.approx(0.6)


def test_time_stamps_are_preferred_to_the_interval(tmp_path: Path) -> None:
    text = pings(WITH_GAP, 49, interval_s=0.2)
    result = outage.read(write_fault(tmp_path, FaultKind.REBOOT, text, duration_text="0.000"), FaultKind.REBOOT)
    assert result.outage_s == result.recovery_s == pytest.approx(5.2)


def test_recovery_is_never_negative(tmp_path: Path) -> None:
    result = outage.read(
        write_fault(tmp_path, FaultKind.LINK_DOWN, pings(WITH_GAP, 49), duration_text="2.7"), FaultKind.LINK_DOWN
    )
    assert result.recovery_s == 0.0


def test_a_fault_of_unknown_duration_has_an_outage_and_no_recovery_time(tmp_path: Path) -> None:
    kind = FaultKind.OUT_OF_RANGE
    result = outage.read(write_fault(tmp_path, kind, pings(WITH_GAP, 49), duration_text="unknown"), kind)
    assert result == Recovery(pytest.approx(2.6), None, recovered=True)  # type: ignore[arg-type]


@pytest.mark.parametrize("n_sent", [20, 600])
def test_a_robot_that_does_not_recover_has_no_times(tmp_path: Path, n_sent: int) -> None:
    text = pings(list(range(1, 11)), n_sent)
    kind = FaultKind.LINK_DOWN
    result = outage.read(write_fault(tmp_path, kind, text), kind)
    fault_s = 2.0
    bound_s = max(0.0, (n_sent - 10) * 0.1 - fault_s)
    assert result == Recovery(None, None, recovered=False, recovery_at_least_s=pytest.approx(bound_s))  # type: ignore[arg-type]
    values = outage.measure(kind, result).values
    assert values.keys() == {"link_down_recovered", "link_down_recovery_at_least_s"}


def test_a_robot_that_becomes_silent_again_has_not_recovered(tmp_path: Path) -> None:
    text = pings([*range(1, 11), *range(36, 40)], 60)
    assert not outage.read(
        write_fault(tmp_path, FaultKind.REBOOT, text, duration_text="0.0"), FaultKind.REBOOT
    ).recovered


def test_duplicates_and_damaged_answers_do_not_count(tmp_path: Path) -> None:
    text = pings(WITH_GAP, 49).replace(
        "icmp_seq=36 ttl=64 time=0.6 ms", "icmp_seq=36 ttl=64 time=0.6 ms (BAD CHECKSUM!)"
    )
    result = outage.read(write_fault(tmp_path, FaultKind.LINK_DOWN, text), FaultKind.LINK_DOWN)
    assert result.outage_s == pytest.approx(2.7)


def test_the_outage_of_a_process_is_between_the_last_observation_and_the_next(tmp_path: Path) -> None:
    text = watch_output((5.0, "31 40"), (5.1, "31"), (5.2, ""), (5.3, ""), (5.4, "77"), (5.5, "77"))
    result = outage.read(write_fault(tmp_path, FaultKind.KILL, text, duration_text="0.000"), FaultKind.KILL)
    assert result.recovered
    assert result.outage_s == result.recovery_s == pytest.approx(0.3)


def test_a_process_that_does_not_recover_has_a_lower_bound(tmp_path: Path) -> None:
    text = watch_output((1.0, ""), (4.9, "31"), (5.0, "31"), *((5.1 + n / 10, "") for n in range(20)))
    result = outage.read(write_fault(tmp_path, FaultKind.KILL, text, duration_text="0.000"), FaultKind.KILL)
    assert result == Recovery(None, None, recovered=False, recovery_at_least_s=pytest.approx(2.0))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "text", "message"),
    [
        (FaultKind.LINK_DOWN, pings(list(range(1, 60)), 59), "had no effect"),
        (FaultKind.REBOOT, pings([1, 2, 4, 5], 5), "had no effect"),
        (FaultKind.LINK_DOWN, pings([], 59), "did not answer before"),
        (FaultKind.LINK_DOWN, pings(WITH_GAP, 49).partition("\n\n")[0], "stopped before its summary"),
        (FaultKind.KILL, watch_output((5.0, "31"), (5.1, "31 32"), (5.2, "31")), "had no effect"),
        (FaultKind.KILL, watch_output((5.0, ""), (5.1, "")), "did not answer before"),
        (FaultKind.KILL, "", "did not answer before"),
    ],
)
def test_evidence_without_effect_of_the_fault_is_an_error(
    tmp_path: Path, kind: FaultKind, text: str, message: str
) -> None:
    with pytest.raises(EvidenceError, match=message):
        outage.read(write_fault(tmp_path, kind, text), kind)


@pytest.mark.parametrize(
    "duration_note", ["", "lasted_s 2\n", "lasted_s -2\ninterval_s 0.1\n", "lasted_s nan\ninterval_s 1\n"]
)
def test_a_note_without_the_duration_is_an_error(tmp_path: Path, duration_note: str) -> None:
    write_fault(tmp_path, FaultKind.LINK_DOWN, pings(WITH_GAP, 49))
    (tmp_path / "fault-link-down.txt").write_text(duration_note, encoding="utf-8")
    with pytest.raises(EvidenceError, match="duration of the fault"):
        outage.read(tmp_path, FaultKind.LINK_DOWN)


def test_a_missing_file_is_an_evidence_error(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="cannot be read"):
        outage.read(tmp_path, FaultKind.REBOOT)


def test_each_kind_has_separate_columns_and_no_transfer_is_needed(tmp_path: Path) -> None:
    write_fault(tmp_path, FaultKind.LINK_DOWN, pings(WITH_GAP, 49))
    write_fault(tmp_path, FaultKind.REBOOT, pings(list(range(1, 11)), 600), duration_text="0.000")
    result = measure(tmp_path, None)
    assert result.link_down_outage_s == pytest.approx(2.6)
    assert result.link_down_recovered is True
    assert (result.reboot_outage_s, result.reboot_recovery_s, result.reboot_recovered) == (None, None, False)
    assert result.kill_recovered is None, "there was no such fault"
    assert result.sent_bytes is None


@given(
    gap_length=st.integers(31, 400),
    before=st.integers(1, 50),
    after=st.integers(1, 50),
    lost_numbers=st.sets(st.integers(1, 1000), max_size=20),
)
def test_the_longest_gap_is_detected_at_any_position(
    tmp_path_factory: pytest.TempPathFactory, gap_length: int, before: int, after: int, lost_numbers: set[int]
) -> None:
    """The oracle is a loop over all requests; `gap_length` exceeds all other losses."""
    path = tmp_path_factory.mktemp("fault")
    answered_numbers = [number for number in range(1, before + 1) if number not in lost_numbers or number == before]
    gap_end = before + gap_length
    answered_numbers += [
        number for number in range(gap_end, gap_end + after) if number not in lost_numbers or number == gap_end
    ]
    n_sent = answered_numbers[-1]
    run_length = longest = 0
    for number in range(answered_numbers[0], n_sent + 1):
        run_length = 0 if number in set(answered_numbers) else run_length + 1
        longest = max(longest, run_length)
    result = outage.read(write_fault(path, FaultKind.LINK_DOWN, pings(answered_numbers, n_sent)), FaultKind.LINK_DOWN)
    assert result.outage_s == pytest.approx((longest + 1) / 10, abs=1e-5)


@given(kind=st.sampled_from(FaultKind), text=st.text(), duration_note=st.text())
def test_any_file_of_a_robot_is_measured_or_refused(
    tmp_path_factory: pytest.TempPathFactory, kind: FaultKind, text: str, duration_note: str
) -> None:
    path = write_fault(tmp_path_factory.mktemp("fault"), kind, text)
    (path / f"fault-{kind}.txt").write_text(f"lasted_s 1\ninterval_s 0.1\n{duration_note}", encoding="utf-8")
    try:
        result = outage.read(path, kind)
    except EvidenceError:
        return
    assert result.outage_s is None or result.outage_s >= 0
