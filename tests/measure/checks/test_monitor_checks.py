"""Columns of frames on monitor interfaces, and contradictions between them and the other sources."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from fieldkit.core.model import LinkSample, Role, StationSample
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import radiotap
from fieldkit.measure.captures.radiotap import NO_SIGNAL, RETRY, UNKNOWN, RadioFrames
from fieldkit.measure.checks import monitor_checks, monitor_columns
from fieldkit.measure.evidence.tcpdump_log import capture_file, monitor_file
from tests.helpers.captures import RECEIVER, Frame, ipv4
from tests.helpers.captures import packets as captured
from tests.helpers.paths import DATA

OWN, PEER = 0x020000000000, 0x020000000100
PEER_NAME = "02:00:00:00:01:00"
QOS_DATA, BEACON = 0x88, 0x80
STEP_NS = 100_000_000
FRAMES = 60
RATE_BIT_S = 65_000_000
SIGNAL_DBM = -50


def exchange(*, retries: int = 0) -> RadioFrames:
    """Return frames of a radio that sends and receives in turn; every tenth sent frame has `retries`."""
    number = np.arange(FRAMES)
    is_sent = number % 2 == 0
    return RadioFrames(
        time_ns=number * STEP_NS,
        is_sent=is_sent,
        kind=np.full(FRAMES, QOS_DATA),
        flags=np.zeros(FRAMES, dtype=np.int64),
        receiver=np.where(is_sent, PEER, OWN),
        transmitter=np.where(is_sent, OWN, PEER),
        sequence=number // 2 << 4,
        signal_dbm=np.where(is_sent, NO_SIGNAL, SIGNAL_DBM),
        rate_bit_s=np.full(FRAMES, RATE_BIT_S),
        retries=np.where(is_sent, np.where(number % 10 == 0, retries, 0), UNKNOWN),
        is_failed=np.zeros(FRAMES, dtype=np.bool_),
        has_many_packets=np.zeros(FRAMES, dtype=np.bool_),
    )


def samples(
    frames: RadioFrames, changes: Mapping[str, float] = MappingProxyType({}), *, at: Sequence[int] = (10, 30, 50)
) -> list[LinkSample]:
    """Return samples of the counters at the times of some frames; `changes` replace values of the last one."""
    result = []
    for row in at:
        earlier = frames.where(slice(0, row + 1))
        sent = earlier.where(earlier.is_sent)
        station = StationSample(
            station=PEER_NAME,
            signal_dbm=float(SIGNAL_DBM),
            tx_rate_bit_s=float(RATE_BIT_S),
            rx_rate_bit_s=float(RATE_BIT_S),
            tx_packets=len(sent),
            rx_packets=len(earlier) - len(sent),
            tx_retries=int(sent.retries.sum()),
            tx_failures=0,
        )
        if row == at[-1]:
            station = replace(station, **changes)  # type: ignore[arg-type]
        result.append(LinkSample(int(frames.time_ns[row]) + 1, (station,)))
    return result


@pytest.mark.parametrize("retries", [0, 3])
def test_counters_signals_and_rates_of_the_same_frames_do_not_contradict_them(retries: int) -> None:
    frames = exchange(retries=retries)
    assert list(monitor_checks.link_contradictions(frames, samples(frames))) == []


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"tx_packets": 99}, "packets sent"),
        ({"tx_packets": 17}, "packets sent"),
        ({"tx_retries": 30}, "retransmissions"),
        ({"tx_failures": 1}, "failed packets"),
        ({"rx_packets": 99}, "packets received"),
        ({"rx_packets": 16}, "packets received"),
        ({"signal_dbm": -60.0}, "signal -60 dBm"),
        ({"tx_rate_bit_s": 6e6}, "6 Mbit/s for frames sent"),
        ({"rx_rate_bit_s": 6e6}, "6 Mbit/s for frames received"),
    ],
)
def test_a_sample_that_contradicts_the_frames_is_reported(changes: dict[str, float], text: str) -> None:
    frames = exchange()
    (contradiction,) = monitor_checks.link_contradictions(frames, samples(frames, changes))
    assert text in contradiction


def test_rates_during_retransmissions_are_not_compared() -> None:
    frames = exchange(retries=1)
    recorded = samples(frames, {"tx_rate_bit_s": 6e6}, at=(9, 29, 50))
    assert list(monitor_checks.link_contradictions(frames, recorded)) == []


def test_samples_outside_of_the_capture_are_not_compared() -> None:
    frames = exchange()
    recorded = samples(frames, {"signal_dbm": -60.0, "tx_packets": 99})
    assert list(monitor_checks.link_contradictions(frames.where(slice(0, 50)), recorded)) == []
    assert list(monitor_checks.link_contradictions(frames.where(slice(0, 0)), recorded)) == []


@pytest.mark.parametrize(("packets", "contradictions"), [(30, 0), (31, 1)])
def test_each_received_packet_needs_a_frame(packets: int, contradictions: int) -> None:
    capture = captured(Frame(number, ipv4(bytes(8), protocol=1)) for number in range(packets))
    found = list(monitor_checks.packet_contradictions(exchange(), capture, RECEIVER))
    assert len(found) == contradictions
    aggregated = replace(exchange(), has_many_packets=np.ones(FRAMES, dtype=np.bool_))
    assert list(monitor_checks.packet_contradictions(aggregated, capture, RECEIVER)) == []


def as_received(frames: RadioFrames) -> RadioFrames:
    """Return the frames that a radio has sent as the other radio receives them, and one that it sends itself."""
    sent = frames.where(frames.is_sent)
    return replace(
        sent,
        is_sent=np.zeros(len(sent), dtype=np.bool_),
        flags=np.where(sent.retries > 0, RETRY, 0),
        retries=np.full(len(sent), UNKNOWN),
        signal_dbm=np.full(len(sent), SIGNAL_DBM),
    )


def with_unsent_frame(frames: RadioFrames) -> RadioFrames:
    return replace(frames, sequence=np.where(np.arange(len(frames)) == 7, 4095 << 4, frames.sequence))


def with_wrong_flag(frames: RadioFrames) -> RadioFrames:
    return replace(frames, flags=np.where(np.arange(len(frames)) == 7, RETRY, frames.flags))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda frames: frames, None),
        (lambda frames: frames.where(slice(3, 20)), None),
        (with_unsent_frame, "1 frame of the other robot are missing"),
        (with_wrong_flag, "1 frame of the other robot have the retry flag"),
    ],
)
def test_received_frames_are_compared_with_those_that_the_other_robot_sent(
    change: Callable[[RadioFrames], RadioFrames], text: str | None
) -> None:
    sent = exchange(retries=2)
    found = list(monitor_checks.peer_contradictions(sent, change(as_received(sent))))
    assert [text is not None and text in reason for reason in found] == ([True] if text else [])


def test_columns_count_data_frames_for_single_receivers() -> None:
    frames = exchange(retries=2)
    beacons = replace(frames, kind=np.full(FRAMES, BEACON), receiver=np.full(FRAMES, 0xFFFFFFFFFFFF))
    measured = monitor_columns.measure(Role.SENDER, RadioFrames.concatenated([frames, beacons]))
    assert measured.values == {
        "sender_monitor_sent": 30,
        "sender_monitor_retries": 12,
        "sender_monitor_failures": 0,
        "sender_monitor_received": 30,
        "sender_monitor_retry_flags": 0,
        "sender_monitor_signal_dbm": SIGNAL_DBM,
        "sender_monitor_tx_phy_rate_bit_s": RATE_BIT_S,
        "sender_monitor_rx_phy_rate_bit_s": RATE_BIT_S,
    }
    assert not measured.missing
    empty = monitor_columns.measure(Role.SENDER, frames.where(slice(0, 0)))
    assert {*empty.values, *empty.missing} == {column.name for column in monitor_columns.COLUMNS_BY_ROLE[Role.SENDER]}
    assert "sender_monitor_signal_dbm" in empty.missing


@pytest.mark.parametrize("role", monitor_columns.ROLES)
def test_real_captures_do_not_contradict_the_other_sources(role: Role) -> None:
    evidence = AttemptEvidence(DATA / "hwsim/6.1.176/mesh-trial")
    frames = {role: radiotap.read(evidence.folder / monitor_file(role)).frames for role in monitor_columns.ROLES}
    other = next(other for other in frames if other != role)
    address = {Role.SENDER: "10.42.0.1", Role.RECEIVER: "10.42.0.2"}[role]
    capture = evidence.undamaged_capture(capture_file(role))
    assert capture is not None
    assert len(evidence.links(role)) >= 10
    assert list(monitor_checks.link_contradictions(frames[role], evidence.links(role))) == []
    assert list(monitor_checks.packet_contradictions(frames[role], capture.packets, address)) == []
    assert list(monitor_checks.peer_contradictions(frames[other], frames[role])) == []
    # A radio that reported other values would contradict the same capture.
    weaker = replace(frames[role], signal_dbm=np.where(frames[role].is_sent, NO_SIGNAL, frames[role].signal_dbm - 9))
    more_retries = replace(frames[role], retries=np.where(frames[role].is_sent, 1, UNKNOWN))
    for altered in (weaker, more_retries):
        assert list(monitor_checks.link_contradictions(altered, evidence.links(role))) != []
