"""Outages of robots, from handwritten files in the format of the observer."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import FaultKind
from fieldkit.measure.evidence import outage
from fieldkit.measure.evidence.outage import Recovery
from tests.helpers.measures import measure

HEAD = "PING 10.42.0.1 (10.42.0.1) 56(84) bytes of data."
FIRST_S = 1_795_218_000


def pings(answered: list[int], sent: int, *, stamps: bool = True, interval_s: float = 0.1) -> str:
    """Output of ping for `sent` requests, of which those in `answered` were answered."""
    lines = [HEAD]
    for number in answered:
        stamp = f"[{FIRST_S + number * interval_s:.6f}] " if stamps else ""
        lines.append(f"{stamp}64 bytes from 10.42.0.1: icmp_seq={number} ttl=64 time=0.6 ms")
    return "\n".join([*lines, "", "--- 10.42.0.1 ping statistics ---", summary(sent, len(answered))])


def summary(sent: int, received: int) -> str:
    return f"{sent} packets transmitted, {received} received, 1% packet loss, time 6066ms"


def watched(*polls: tuple[float, str]) -> str:
    return "\n".join(["watching nc", *(f"{at_s:.2f}{f' up {pids}' if pids else ''}" for at_s, pids in polls), ""])


def folder(path: Path, kind: FaultKind, text: str, lasted: str = "2.000", interval: str = "0.1") -> Path:
    name = "watch" if kind is FaultKind.KILL else "ping"
    (path / f"fault-{kind}-{name}.txt").write_text(text, encoding="utf-8")
    (path / f"fault-{kind}.txt").write_text(f"lasted_s {lasted}\ninterval_s {interval}\n", encoding="utf-8")
    return path


AWAY = [*range(1, 11), *range(36, 50)]
"""The 25 requests from 11 to 35 have no answer: 2.6 s between two answers."""


@pytest.mark.parametrize("stamps", [True, False])
def test_the_outage_is_the_longest_gap_and_the_recovery_its_part_after_the_cause(
    tmp_path: Path, stamps: bool
) -> None:
    result = outage.read(folder(tmp_path, FaultKind.LINK_DOWN, pings(AWAY, 49, stamps=stamps)), FaultKind.LINK_DOWN)
    assert result.recovered
    assert result.outage_s == pytest.approx(2.6)
    assert result.recovery_s == pytest.approx(0.6)


def test_time_stamps_are_preferred_to_the_interval(tmp_path: Path) -> None:
    text = pings(AWAY, 49, interval_s=0.2)
    result = outage.read(folder(tmp_path, FaultKind.REBOOT, text, lasted="0.000"), FaultKind.REBOOT)
    assert result.outage_s == result.recovery_s == pytest.approx(5.2)


def test_recovery_is_never_negative(tmp_path: Path) -> None:
    result = outage.read(folder(tmp_path, FaultKind.LINK_DOWN, pings(AWAY, 49), lasted="2.7"), FaultKind.LINK_DOWN)
    assert result.recovery_s == 0.0


def test_without_the_cause_s_time_there_is_an_outage_and_no_recovery_time(tmp_path: Path) -> None:
    kind = FaultKind.OUT_OF_RANGE
    result = outage.read(folder(tmp_path, kind, pings(AWAY, 49), lasted="unknown"), kind)
    assert result == Recovery(pytest.approx(2.6), None, recovered=True)  # type: ignore[arg-type]


@pytest.mark.parametrize("sent", [20, 600])
def test_a_robot_that_does_not_recover_has_no_times(tmp_path: Path, sent: int) -> None:
    text = pings(list(range(1, 11)), sent)
    kind = FaultKind.LINK_DOWN
    result = outage.read(folder(tmp_path, kind, text), kind)
    lasted_s = 2.0  # duration of the cause
    bound_s = max(0.0, (sent - 10) * 0.1 - lasted_s)
    assert result == Recovery(None, None, recovered=False, recovery_at_least_s=pytest.approx(bound_s))  # type: ignore[arg-type]
    values = outage.measure(kind, result).values
    assert values.keys() == {"link_down_recovered", "link_down_recovery_at_least_s"}


def test_a_robot_that_is_silent_again_has_not_recovered(tmp_path: Path) -> None:
    text = pings([*range(1, 11), *range(36, 40)], 60)
    assert not outage.read(folder(tmp_path, FaultKind.REBOOT, text, lasted="0.0"), FaultKind.REBOOT).recovered


def test_duplicates_and_damaged_answers_are_no_answers(tmp_path: Path) -> None:
    text = pings(AWAY, 49).replace("icmp_seq=36 ttl=64 time=0.6 ms", "icmp_seq=36 ttl=64 time=0.6 ms (BAD CHECKSUM!)")
    result = outage.read(folder(tmp_path, FaultKind.LINK_DOWN, text), FaultKind.LINK_DOWN)
    assert result.outage_s == pytest.approx(2.7)


def test_the_outage_of_a_process_is_between_the_last_observation_and_the_next(tmp_path: Path) -> None:
    text = watched((5.0, "31 40"), (5.1, "31"), (5.2, ""), (5.3, ""), (5.4, "77"), (5.5, "77"))
    result = outage.read(folder(tmp_path, FaultKind.KILL, text, lasted="0.000"), FaultKind.KILL)
    assert result.recovered
    assert result.outage_s == result.recovery_s == pytest.approx(0.3)


def test_a_process_that_does_not_recover(tmp_path: Path) -> None:
    text = watched((1.0, ""), (4.9, "31"), (5.0, "31"), *((5.1 + n / 10, "") for n in range(20)))
    result = outage.read(folder(tmp_path, FaultKind.KILL, text, lasted="0.000"), FaultKind.KILL)
    assert result == Recovery(None, None, recovered=False, recovery_at_least_s=pytest.approx(2.0))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "text", "complaint"),
    [
        (FaultKind.LINK_DOWN, pings(list(range(1, 60)), 59), "had no effect"),
        (FaultKind.REBOOT, pings([1, 2, 4, 5], 5), "had no effect"),
        (FaultKind.LINK_DOWN, pings([], 59), "did not answer before"),
        (FaultKind.LINK_DOWN, pings(AWAY, 49).partition("\n\n")[0], "stopped before its summary"),
        (FaultKind.KILL, watched((5.0, "31"), (5.1, "31 32"), (5.2, "31")), "had no effect"),
        (FaultKind.KILL, watched((5.0, ""), (5.1, "")), "did not answer before"),
        (FaultKind.KILL, "", "did not answer before"),
    ],
)
def test_evidence_without_effect_of_the_fault_is_an_error(
    tmp_path: Path, kind: FaultKind, text: str, complaint: str
) -> None:
    with pytest.raises(EvidenceError, match=complaint):
        outage.read(folder(tmp_path, kind, text), kind)


@pytest.mark.parametrize(
    "note", ["", "lasted_s 2\n", "lasted_s -2\ninterval_s 0.1\n", "lasted_s nan\ninterval_s 1\n"]
)
def test_a_note_without_the_duration_is_an_error(tmp_path: Path, note: str) -> None:
    folder(tmp_path, FaultKind.LINK_DOWN, pings(AWAY, 49))
    (tmp_path / "fault-link-down.txt").write_text(note, encoding="utf-8")
    with pytest.raises(EvidenceError, match="duration of the fault"):
        outage.read(tmp_path, FaultKind.LINK_DOWN)


def test_a_missing_file_is_an_evidence_error(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="cannot be read"):
        outage.read(tmp_path, FaultKind.REBOOT)


def test_each_kind_has_separate_columns_and_no_transfer_is_needed(tmp_path: Path) -> None:
    folder(tmp_path, FaultKind.LINK_DOWN, pings(AWAY, 49))
    folder(tmp_path, FaultKind.REBOOT, pings(list(range(1, 11)), 600), lasted="0.000")
    result = measure(tmp_path, None)
    assert result.link_down_outage_s == pytest.approx(2.6)
    assert result.link_down_recovered is True
    assert (result.reboot_outage_s, result.reboot_recovery_s, result.reboot_recovered) == (None, None, False)
    assert result.kill_recovered is None, "there was no such fault"
    assert result.sent_bytes is None


@given(
    gone=st.integers(31, 400),
    before=st.integers(1, 50),
    after=st.integers(1, 50),
    lost=st.sets(st.integers(1, 1000), max_size=20),
)
def test_the_longest_gap_is_found_at_any_position(
    tmp_path_factory: pytest.TempPathFactory, gone: int, before: int, after: int, lost: set[int]
) -> None:
    """Oracle: the longest run of unanswered requests, found by a loop; `gone` is longer than all losses."""
    path = tmp_path_factory.mktemp("fault")
    answered = [number for number in range(1, before + 1) if number not in lost or number == before]
    back = before + gone
    answered += [number for number in range(back, back + after) if number not in lost or number == back]
    sent = answered[-1]
    run = longest = 0
    for number in range(answered[0], sent + 1):
        run = 0 if number in set(answered) else run + 1
        longest = max(longest, run)
    result = outage.read(folder(path, FaultKind.LINK_DOWN, pings(answered, sent)), FaultKind.LINK_DOWN)
    assert result.outage_s == pytest.approx((longest + 1) / 10, abs=1e-5)


@given(kind=st.sampled_from(FaultKind), text=st.text(), note=st.text())
def test_any_file_of_a_robot_is_measured_or_refused(
    tmp_path_factory: pytest.TempPathFactory, kind: FaultKind, text: str, note: str
) -> None:
    path = folder(tmp_path_factory.mktemp("fault"), kind, text)
    (path / f"fault-{kind}.txt").write_text(f"lasted_s 1\ninterval_s 0.1\n{note}", encoding="utf-8")
    try:
        result = outage.read(path, kind)
    except EvidenceError:
        return
    assert result.outage_s is None or result.outage_s >= 0
