"""Throughput and goodput compared with closed forms for links of a given rate and files with a given end."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.transfers import rates, tcp, udp
from fieldkit.measure.transfers.rates import Rates
from tests.helpers.captures import Frame, datagram, packets, segment, timed, transfer

START_NS = 1_700_000_000_000_000_000
SYN, FIN_ACK, ACK = 0x02, 0x11, 0x10
ISN = 2**32 - 3000
NS_PER_BIT = 1000  # 1 Mbit/s
SEGMENT = 1448
HEADERS = 40

sizes = st.lists(st.integers(0, 9000), min_size=1, max_size=8)


def length(data: bytes) -> int:
    """Return the length of an IPv4 packet from its header."""
    return int.from_bytes(data[2:4], "big")


def through_link(data: Sequence[bytes], start_ns: int = START_NS) -> list[Frame]:
    """Return packets at the arrival times of their last bits over a link of 1 Mbit/s that is always busy."""
    frames, at_ns = [], start_ns
    for packet in data:
        at_ns += 8 * length(packet) * NS_PER_BIT
        frames.append(Frame(at_ns, packet, wire_bytes=len(packet)))
    return frames


def udp_rates(sent_frames: list[Frame], received_frames: list[Frame]) -> Rates:
    return rates.udp_rates(udp.match_transfer(packets(sent_frames), packets(received_frames), transfer(Protocol.UDP)))


def tcp_rates(sent_frames: list[Frame], received_frames: list[Frame]) -> Rates:
    sent_packets, received_packets, transfer_spec = (
        packets(sent_frames),
        packets(received_frames),
        transfer(Protocol.TCP),
    )
    crossing = tcp.match_transfer(sent_packets, received_packets, transfer_spec)
    return rates.tcp_rates(crossing, received_packets, transfer_spec, tcp.count(crossing))


@given(sizes)
def test_throughput_of_a_busy_link_is_its_rate_and_goodput_excludes_headers(sizes: list[int]) -> None:
    sent_packets = [packet for ip_id, size in enumerate(sizes) for packet in datagram(ip_id, size)]
    result = udp_rates(timed(sent_packets), through_link(sent_packets))
    if len(sent_packets) == 1:
        assert (result.throughput_bit_s, result.values(sum(sizes))["goodput_bit_s"]) == (None, None)
        return
    assert result.throughput_bit_s == pytest.approx(1e6)
    lengths = list(map(length, sent_packets))
    assert result.completion_s == pytest.approx(8 * sum(lengths[1:]) / 1e6)
    payload = sum(sizes) - (min(lengths[0] - 20, 1480) - 8)
    assert result.values(sum(sizes))["goodput_bit_s"] == pytest.approx(1e6 * payload / sum(lengths[1:]))


@given(sizes, st.data())
def test_lost_fragments_do_not_count_and_copied_fragments_do(sizes: list[int], data: st.DataObject) -> None:
    fragments_by_datagram = [datagram(ip_id, size) for ip_id, size in enumerate(sizes)]
    sent_packets = timed([packet for fragments in fragments_by_datagram for packet in fragments])
    copies = data.draw(
        st.lists(st.sampled_from((0, 1, 1, 2)), min_size=len(sent_packets), max_size=len(sent_packets))
    )
    arrived_packets = [packet.data for packet, count in zip(sent_packets, copies, strict=True) for _ in range(count)]
    received_frames = through_link(arrived_packets)
    result = udp_rates(sent_packets, received_frames)

    later_bytes = sum(map(length, arrived_packets[1:]))
    assert result.throughput_bit_s == (pytest.approx(1e6) if later_bytes else None)
    end_times_ns, index = [], 0
    for fragments in fragments_by_datagram:
        if all(copies[index : index + len(fragments)]):
            last_index = sum(copies[: index + len(fragments)]) - copies[index + len(fragments) - 1]
            end_times_ns.append(received_frames[last_index].time_ns)
        index += len(fragments)
    assert result.completion_s == (
        pytest.approx((max(end_times_ns) - received_frames[0].time_ns) / 1e9) if end_times_ns else None
    )


def stream(total: int, *, segments_per_frame: int = 1, repeated_frames: Sequence[int] = ()) -> list[bytes]:
    """Return frames of `segments_per_frame` segments; the frames `repeated_frames` are sent again at the end."""
    starts = list(range(0, total, segments_per_frame * SEGMENT))
    starts += [starts[index] for index in repeated_frames]
    data = [segment(ISN + 1 + offset, min(segments_per_frame * SEGMENT, total - offset)) for offset in starts]
    return [segment(ISN, 0, flags=SYN, mss=1460), *data]


def with_fin(received_frames: list[Frame], after_ns: int, acknowledged: int) -> list[Frame]:
    """Add the receiver's FIN after `after_ns`. It acknowledges `acknowledged` bytes and the sender's FIN."""
    at_ns = received_frames[-1].time_ns + after_ns
    return [*received_frames, Frame(at_ns, segment(77, 0, flags=FIN_ACK, ack=ISN + 1 + acknowledged + 1, back=True))]


@given(st.integers(2 * SEGMENT, 60_000), st.integers(0, 10**9))
def test_a_tcp_transfer_is_complete_when_the_receiver_closes(total: int, after_ns: int) -> None:
    """In most examples the sequence numbers wrap."""
    sent_packets = stream(total)
    received_frames = through_link(sent_packets)
    result = tcp_rates(timed(sent_packets), with_fin(received_frames, after_ns, total))
    assert result.throughput_bit_s == pytest.approx(1e6)
    completion_s = (received_frames[-1].time_ns + after_ns - received_frames[0].time_ns) / 1e9
    assert result.completion_s == pytest.approx(completion_s)
    assert result.values(total)["goodput_bit_s"] == pytest.approx(8 * total / completion_s)


def test_retransmissions_count_in_throughput_but_not_in_goodput() -> None:
    total, sent_packets = 10 * SEGMENT, stream(10 * SEGMENT, repeated_frames=[3, 3, 4])
    received_frames = through_link(sent_packets)
    result = tcp_rates(timed(sent_packets), with_fin(received_frames, 0, total))
    assert result.throughput_bit_s == pytest.approx(1e6)
    duration_s = (received_frames[-1].time_ns - received_frames[0].time_ns) / 1e9
    assert result.values(total)["goodput_bit_s"] == pytest.approx(8 * total / duration_s)


@pytest.mark.parametrize("segments_per_frame", [2, 10, 40])
def test_segments_that_offload_joined_have_the_throughput_of_the_link(segments_per_frame: int) -> None:
    sent_frames = timed(stream(120 * SEGMENT))
    at_ns, frames = START_NS, []
    for packet in stream(120 * SEGMENT, segments_per_frame=segments_per_frame):
        payload = length(packet) - HEADERS
        at_ns += 8 * NS_PER_BIT * (length(packet) + max(0, -(-payload // SEGMENT) - 1) * HEADERS)
        frames.append(Frame(at_ns, packet, wire_bytes=length(packet)))
    assert tcp_rates(sent_frames, frames).throughput_bit_s == pytest.approx(1e6)


@pytest.mark.parametrize(
    "ending",
    [
        [],
        [segment(77, 0, flags=ACK, ack=ISN + 1 + 5000, back=True)],
        [segment(77, 0, flags=FIN_ACK, ack=ISN + 1 + 4999, back=True)],
        [segment(77, 0, flags=FIN_ACK, ack=ISN + 5001, back=True, sport=40001)],
        [segment(77, 0, flags=FIN_ACK, ack=ISN + 5001)],
    ],
    ids=["none", "open", "early", "another's", "sender's"],
)
def test_a_transfer_without_a_close_after_all_bytes_has_no_completion_time(ending: list[bytes]) -> None:
    received_frames = timed([*stream(5000), *ending])
    result = tcp_rates(timed(stream(5000)), received_frames)
    assert (result.completion_s, result.values(5000)["goodput_bit_s"]) == (None, None)
    assert result.throughput_bit_s is not None


def test_packets_without_a_time_span_have_no_rate() -> None:
    sent_packets = [packet for ip_id in range(3) for packet in datagram(ip_id, 8192)]
    simultaneous = [replace(frame, time_ns=START_NS) for frame in timed(sent_packets)]
    assert udp_rates(timed(sent_packets), simultaneous).values(3 * 8192) == {
        "throughput_bit_s": None,
        "completion_s": 0.0,
        "goodput_bit_s": None,
    }
    assert udp_rates(timed(sent_packets), []) == Rates(None, None)
    assert tcp_rates(timed(stream(5000)), timed(stream(0))) == Rates(None, None)


def test_a_transfer_without_a_received_file_has_no_goodput() -> None:
    sent_packets = [packet for ip_id in range(3) for packet in datagram(ip_id, 8192)]
    assert udp_rates(timed(sent_packets), timed(sent_packets)).values(0)["goodput_bit_s"] == 0
    assert udp_rates(timed(sent_packets), timed(sent_packets)).values(None)["goodput_bit_s"] is None
