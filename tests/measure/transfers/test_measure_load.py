"""Columns of an iperf3 test from captures with given times and sizes of packets."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.transfers import iperf3_load
from fieldkit.measure.transfers.iperf3_load import LoadFlow
from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame, datagram, packets, segment, timed

PAYLOAD_BYTES = 1000
PERIOD_NS = 10_000_000  # 100 packets a second
UDP = LoadFlow(Protocol.UDP, SENDER, RECEIVER, ((40000, PORT),), PAYLOAD_BYTES, (1.0, 3.0))
TCP = replace(UDP, protocol=Protocol.TCP)
RATE = 8 * PAYLOAD_BYTES * 100
SYN = 0x02
COOKIE = 37
START = 1_700_000_000_000_000_000


def udp_frames(count: int) -> list[Frame]:
    """Return a datagram of the setup with 4 bytes, and datagrams among packets with another port."""
    data = [datagram(index, PAYLOAD_BYTES)[0] for index in range(count)]
    frames = [Frame(START - 10**9, datagram(9_000, 4)[0]), *timed(data, start_ns=START, step_ns=PERIOD_NS)]
    other_datagrams = [datagram(9_001, PAYLOAD_BYTES, sport=40001)[0], datagram(9_002, PAYLOAD_BYTES, port=5202)[0]]
    return [*frames, *timed(other_datagrams, start_ns=START + 5 * 10**8)]


def tcp_frames(count: int, *, repeated: tuple[int, ...] = ()) -> list[Frame]:
    """Return a connection with SYN, cookie and segments, of which those at the indices `repeated` are sent twice."""
    header_frames = [segment(0, 0, flags=SYN), segment(1, COOKIE)]
    segments = [segment(1 + COOKIE + index * PAYLOAD_BYTES, PAYLOAD_BYTES) for index in range(count)]
    frames = [*timed(header_frames, start_ns=START - 10**9), *timed(segments, start_ns=START, step_ns=PERIOD_NS)]
    return frames + [Frame(START + index * PERIOD_NS + 1_000_000, segments[index]) for index in repeated]


def measure_values(flow: LoadFlow, sent_frames: list[Frame], received_frames: list[Frame]) -> dict[str, object]:
    result = iperf3_load.measure_totals(flow, packets(sent_frames), packets(received_frames))
    assert result.values.keys() | result.missing.keys() == {column.name for column in iperf3_load.COLUMNS}
    return dict(result.values)


def test_the_rate_includes_the_datagrams_in_the_measured_seconds() -> None:
    frames = udp_frames(400)
    result = measure_values(UDP, frames, frames)
    assert result == {"iperf3_captured_bit_s": RATE, "iperf3_captured_loss": 0.0}


@given(st.sets(st.integers(0, 399), max_size=399))
def test_losses_of_the_radio_are_counted(lost_indices: set[int]) -> None:
    sent_frames = udp_frames(400)
    received_frames = [frame for index, frame in enumerate(sent_frames) if index - 1 not in lost_indices]
    result = measure_values(UDP, sent_frames, received_frames)
    assert result["iperf3_captured_loss"] == pytest.approx(len(lost_indices) / 400)
    first = min(set(range(400)) - lost_indices)
    n_received = sum(index not in lost_indices for index in range(first + 100, min(first + 300, 400)))
    assert result["iperf3_captured_bit_s"] == pytest.approx(8 * PAYLOAD_BYTES * n_received / 2.0)


def test_retransmitted_bytes_count_once_in_the_rate() -> None:
    sent_frames = tcp_frames(400, repeated=tuple(range(0, 400, 10)))
    result = measure_values(TCP, sent_frames, sent_frames)
    assert result == {"iperf3_captured_bit_s": RATE, "iperf3_captured_loss": 0.0}


def test_retransmissions_count_in_the_loss() -> None:
    repeated = tuple(range(0, 400, 10))
    result = measure_values(TCP, tcp_frames(400, repeated=repeated), tcp_frames(400))
    sent_bytes = 440 * PAYLOAD_BYTES + COOKIE
    assert result["iperf3_captured_loss"] == pytest.approx(40 * PAYLOAD_BYTES / sent_bytes)
    assert result["iperf3_captured_bit_s"] == RATE


def test_streams_are_summed() -> None:
    second = [
        Frame(frame.time_ns, datagram(20_000 + index, PAYLOAD_BYTES, sport=50_000)[0])
        for index, frame in enumerate(udp_frames(400)[1:401])
    ]
    all_frames = udp_frames(400) + second
    flow = replace(UDP, ports=((40000, PORT), (50000, PORT)))
    assert measure_values(flow, all_frames, all_frames)["iperf3_captured_bit_s"] == 2 * RATE


def test_fragmented_datagrams_have_no_loss() -> None:
    flow = replace(UDP, payload_bytes=3000)
    data = [piece for index in range(400) for piece in datagram(index, 3000)]
    frames = timed(data, start_ns=START, step_ns=PERIOD_NS // 3)
    result = measure_values(flow, frames, frames)
    assert "iperf3_captured_loss" not in result


@pytest.mark.parametrize(
    "flow",
    [replace(UDP, ports=()), replace(UDP, window_s=(0.0, 0.0)), replace(UDP, destination_address="10.9.0.9")],
)
def test_without_packets_of_the_test_the_columns_are_empty(flow: LoadFlow) -> None:
    frames = udp_frames(400)
    assert "iperf3_captured_bit_s" not in measure_values(flow, frames, frames)


def test_a_connection_without_a_captured_syn_has_no_rate() -> None:
    frames = tcp_frames(400)
    assert "iperf3_captured_bit_s" not in measure_values(TCP, frames, frames[1:])


def test_without_both_captures_the_columns_are_empty() -> None:
    assert not iperf3_load.measure_totals(UDP, None, packets(udp_frames(3))).values
