"""What captures say of an iperf3 test, by packets whose times and sizes are known."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.transfers import load
from fieldkit.measure.transfers.load import LoadFlow
from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame, datagram, packets, segment, timed

PAYLOAD_BYTES = 1000
EVERY_NS = 10_000_000  # 100 packets a second
UDP = LoadFlow(Protocol.UDP, SENDER, RECEIVER, ((40000, PORT),), PAYLOAD_BYTES, (1.0, 3.0))
TCP = replace(UDP, protocol=Protocol.TCP)
RATE = 8 * PAYLOAD_BYTES * 100
SYN = 0x02
COOKIE = 37
START = 1_700_000_000_000_000_000


def udp_frames(count: int) -> list[Frame]:
    """A greeting of 4 bytes, then datagrams; among them packets of another port, and of another size."""
    data = [datagram(index, PAYLOAD_BYTES)[0] for index in range(count)]
    frames = [Frame(START - 10**9, datagram(9_000, 4)[0]), *timed(data, start_ns=START, step_ns=EVERY_NS)]
    strange = [datagram(9_001, PAYLOAD_BYTES, sport=40001)[0], datagram(9_002, PAYLOAD_BYTES, port=5202)[0]]
    return [*frames, *timed(strange, start_ns=START + 5 * 10**8)]


def tcp_frames(count: int, *, again: tuple[int, ...] = ()) -> list[Frame]:
    """A connection: SYN, cookie, then segments, some of them twice."""
    head = [segment(0, 0, flags=SYN), segment(1, COOKIE)]
    whole = [segment(1 + COOKIE + index * PAYLOAD_BYTES, PAYLOAD_BYTES) for index in range(count)]
    frames = [*timed(head, start_ns=START - 10**9), *timed(whole, start_ns=START, step_ns=EVERY_NS)]
    return frames + [Frame(START + index * EVERY_NS + 1_000_000, whole[index]) for index in again]


def measured(flow: LoadFlow, sent: list[Frame], received: list[Frame]) -> dict[str, object]:
    found = load.measure(flow, packets(sent), packets(received))
    assert found.values.keys() | found.missing.keys() == {column.name for column in load.COLUMNS}
    return dict(found.values)


def test_the_rate_is_that_of_the_datagrams_in_the_seconds_that_count() -> None:
    frames = udp_frames(400)
    found = measured(UDP, frames, frames)
    assert found == {"iperf3_captured_bit_s": RATE, "iperf3_captured_loss": 0.0}


@given(st.sets(st.integers(0, 399), max_size=399))
def test_losses_are_those_of_the_radio(lost: set[int]) -> None:
    sent = udp_frames(400)
    received = [frame for index, frame in enumerate(sent) if index - 1 not in lost]
    found = measured(UDP, sent, received)
    assert found["iperf3_captured_loss"] == pytest.approx(len(lost) / 400)
    first = min(set(range(400)) - lost)
    inside = sum(index not in lost for index in range(first + 100, min(first + 300, 400)))
    assert found["iperf3_captured_bit_s"] == pytest.approx(8 * PAYLOAD_BYTES * inside / 2.0)


def test_bytes_that_come_again_count_once_in_the_rate() -> None:
    sent = tcp_frames(400, again=tuple(range(0, 400, 10)))
    found = measured(TCP, sent, sent)
    assert found == {"iperf3_captured_bit_s": RATE, "iperf3_captured_loss": 0.0}


def test_what_was_sent_again_counts_among_what_was_lost() -> None:
    again = tuple(range(0, 400, 10))
    found = measured(TCP, tcp_frames(400, again=again), tcp_frames(400))
    sent_bytes = 440 * PAYLOAD_BYTES + COOKIE
    assert found["iperf3_captured_loss"] == pytest.approx(40 * PAYLOAD_BYTES / sent_bytes)
    assert found["iperf3_captured_bit_s"] == RATE


def test_streams_are_summed() -> None:
    second = [
        Frame(one.time_ns, datagram(20_000 + index, PAYLOAD_BYTES, sport=50_000)[0])
        for index, one in enumerate(udp_frames(400)[1:401])
    ]
    both = udp_frames(400) + second
    flow = replace(UDP, ports=((40000, PORT), (50000, PORT)))
    assert measured(flow, both, both)["iperf3_captured_bit_s"] == 2 * RATE


def test_of_fragments_no_loss_is_told() -> None:
    flow = replace(UDP, payload_bytes=3000)
    data = [piece for index in range(400) for piece in datagram(index, 3000)]
    frames = timed(data, start_ns=START, step_ns=EVERY_NS // 3)
    found = measured(flow, frames, frames)
    assert "iperf3_captured_loss" not in found


@pytest.mark.parametrize(
    "flow",
    [replace(UDP, ports=()), replace(UDP, window_s=(0.0, 0.0)), replace(UDP, destination_address="10.9.0.9")],
)
def test_where_nothing_is_to_be_counted_nothing_is_told(flow: LoadFlow) -> None:
    frames = udp_frames(400)
    assert "iperf3_captured_bit_s" not in measured(flow, frames, frames)


def test_a_connection_whose_beginning_was_not_captured_has_no_rate() -> None:
    frames = tcp_frames(400)
    assert "iperf3_captured_bit_s" not in measured(TCP, frames, frames[1:])


def test_without_both_captures_nothing_is_told() -> None:
    assert not load.measure(UDP, None, packets(udp_frames(3))).values
