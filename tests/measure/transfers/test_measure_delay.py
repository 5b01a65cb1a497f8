"""One-way delay and jitter of crafted and real transfers with two clocks, compared with known values."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from statistics import mean, median

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scapy.layers.inet import ICMP, IP, TCP
from scapy.utils import rdpcap

from fieldkit.core.model import Protocol
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers import delay, tcp, udp
from fieldkit.measure.transfers.transfer_spec import Transfer
from tests.helpers.captures import RECEIVER, SENDER, TCPDUMP, Frame, datagram, ipv4, packets, segment, transfer
from tests.helpers.measures import Measures
from tests.helpers.nightly import examples

TWO_WAY = TCPDUMP / "two-way"
START_NS = 1_700_000_000_000_000_000
MILLISECOND_NS = 1_000_000

ClockError = tuple[float, float]  # offset in seconds, drift in seconds per second
CLOCKS: list[ClockError] = [
    (0, 0),
    (3600, 0),
    (-3600, 0),
    (0, 100e-6),
    (0, -100e-6),
    (3600, -100e-6),
    (-3600, 100e-6),
]


def _measure_delays(
    sender: Packets, receiver: Packets, transfer_filter: Transfer, n_sent: int | None = None
) -> Measures:
    if transfer_filter.protocol is Protocol.UDP:
        pairs = delay.udp_pairs(udp.match_transfer(sender, receiver, transfer_filter))
    else:
        pairs = delay.tcp_pairs(tcp.match_transfer(sender, receiver, transfer_filter))
    columns = delay.measure(pairs, sender, receiver, transfer_filter, sent=len(pairs) if n_sent is None else n_sent)
    assert not columns.values.keys() & columns.missing.keys(), "no column has both a value and a reason"
    assert columns.values.keys() | columns.missing.keys() == {
        column.name for column in (*delay.COLUMNS, *delay.SENT_COLUMNS)
    }
    return Measures(**columns.values)


def _on_another_clock(capture: Packets, offset_s: float, drift: float) -> Packets:
    """Return the capture with times of another clock, in whole microseconds."""
    elapsed_ns = capture.time_ns - START_NS
    wrong_ns = capture.time_ns + np.round(offset_s * 1e9 + drift * elapsed_ns).astype(np.int64)
    return replace(capture, time_ns=wrong_ns // 1000 * 1000)


def _real_delays_s(protocol: Protocol) -> list[float]:
    """Return the delay of each packet of the real transfer, read by scapy. Both captures have the same clock."""
    times_by_capture: list[dict[tuple[int, int], float]] = []
    for role in ("sender", "receiver"):
        times_s = {}
        for frame in rdpcap(str(TWO_WAY / f"{protocol}-{role}.pcap")):
            ip = frame[IP]
            if ip.src != "10.42.0.1" or ICMP in ip or ip.proto == 1:
                continue
            if protocol is Protocol.TCP and ip.len - 20 - ip[TCP].dataofs * 4 == 0:
                continue
            times_s[ip.id, ip.frag] = float(frame.time)
        times_by_capture.append(times_s)
    send_times_s, receive_times_s = times_by_capture
    return [receive_times_s[key] - send_times_s[key] for key in send_times_s if key in receive_times_s]


def _measure_real_transfer(protocol: Protocol, offset_s: float = 0.0, drift: float = 0.0) -> Measures:
    sender, receiver = (pcap.read(TWO_WAY / f"{protocol}-{role}.pcap").packets for role in ("sender", "receiver"))
    start_ns = int(sender.time_ns.min()) - START_NS
    sender, receiver = (replace(capture, time_ns=capture.time_ns - start_ns) for capture in (sender, receiver))
    transfer_filter = replace(transfer(protocol), sender_address="10.42.0.1", receiver_address="10.42.0.2", port=1234)
    return _measure_delays(sender, _on_another_clock(receiver, offset_s, drift), transfer_filter)


@pytest.mark.parametrize(("offset_s", "drift"), CLOCKS)
@pytest.mark.parametrize("protocol", Protocol)
def test_delays_of_a_real_transfer_are_correct_for_any_clock_offset(
    protocol: Protocol, offset_s: float, drift: float
) -> None:
    """Captures of a link with 2 ms, 1 Mbit/s and 3 % loss. Both robots had the same clock, so delays are known."""
    truth_s = _real_delays_s(protocol)
    measures = _measure_real_transfer(protocol, offset_s, drift)
    assert measures.one_way_error_s is not None
    assert measures.one_way_p95_s == pytest.approx(np.percentile(truth_s, 95), abs=measures.one_way_error_s)
    if protocol is Protocol.TCP:
        assert measures.one_way_median_s == pytest.approx(median(truth_s), abs=measures.one_way_error_s)
        assert measures.one_way_mean_s == pytest.approx(mean(truth_s), abs=measures.one_way_error_s)
    variation_s = [delay_s - min(truth_s) for delay_s in truth_s]
    # Drift that the packets do not determine is included: 100 ppm of the transfer's 0.2 s.
    assert measures.delay_variation_median_s == pytest.approx(median(variation_s), abs=30e-6)
    assert measures.clock_offset_s is not None
    assert measures.clock_offset_error_s is not None
    # The drift changes the clock by less than 0.3 ms until the middle of the 2 s.
    assert abs(measures.clock_offset_s - offset_s - drift * 1.0) <= measures.clock_offset_error_s + 3e-4


def test_errors_of_a_real_transfer_are_half_of_the_fastest_round_trip() -> None:
    """An ACK of 52 bytes takes 2.6 ms, a full fragment 14 ms; the UDP repeat has no shorter reverse packet."""
    tcp, udp = _measure_real_transfer(Protocol.TCP), _measure_real_transfer(Protocol.UDP)
    assert tcp.one_way_error_s == pytest.approx(2.5e-3, abs=0.2e-3)
    assert tcp.one_way_withheld == "the error is above a tenth of: min"
    assert udp.one_way_error_s == pytest.approx(15e-3, abs=2e-3)
    assert (udp.one_way_median_s, udp.one_way_withheld) == (None, "the error is above a tenth of: min, median, mean")
    for result in (tcp, udp):
        assert (result.clock_skew_ppm, result.clock_skew_error_ppm) == (None, 500), "2 s do not determine the drift"


def _captures_with_pings(
    send_times_ms: list[float], delay_ms: list[float], clock_error: ClockError, *, ping_delay_ms: float = 1.0
) -> tuple[Packets, Packets]:
    """Return captures of unfragmented datagrams, followed by ten pings. The sender has the true clock."""
    sent_packets = [
        (time_ms, packet_delay_ms, datagram(n, 1000)[0])
        for n, (time_ms, packet_delay_ms) in enumerate(zip(send_times_ms, delay_ms, strict=True))
    ]
    ping_times_ms = [max(send_times_ms) + 10 * n for n in range(1, 11)]
    sent_packets += [
        (time_ms, ping_delay_ms, ipv4(bytes(8), protocol=1, ip_id=60000 + n))
        for n, time_ms in enumerate(ping_times_ms)
    ]
    replies = [
        (time_ms + 2 * ping_delay_ms, ping_delay_ms, ipv4(bytes(8), protocol=1, ip_id=n, src=RECEIVER, dst=SENDER))
        for n, time_ms in enumerate(ping_times_ms)
    ]

    def capture(items: list[tuple[float, bytes]]) -> Packets:
        return packets(
            Frame(START_NS + round(time_ms * MILLISECOND_NS), data)
            for time_ms, data in sorted(items, key=lambda item: item[0])
        )

    sender = capture(
        [(time_ms, data) for time_ms, _, data in sent_packets]
        + [(time_ms + packet_delay_ms, data) for time_ms, packet_delay_ms, data in replies]
    )
    receiver = capture(
        [(time_ms + packet_delay_ms, data) for time_ms, packet_delay_ms, data in sent_packets]
        + [(time_ms, data) for time_ms, _, data in replies]
    )
    return sender, _on_another_clock(receiver, *clock_error)


delays_ms = st.lists(st.floats(1, 400), min_size=2, max_size=30)


@given(st.sampled_from(CLOCKS), delays_ms, st.floats(0.5, 50))
@settings(max_examples=examples(60), deadline=None)
def test_values_are_correct_within_their_error_or_withheld(
    clock_error: ClockError, delay_ms: list[float], ping_delay_ms: float
) -> None:
    sender, receiver = _captures_with_pings(
        [20.0 * n for n in range(len(delay_ms))], delay_ms, clock_error, ping_delay_ms=ping_delay_ms
    )
    measures = _measure_delays(sender, receiver, transfer(Protocol.UDP))
    error_s = measures.one_way_error_s
    assert error_s is not None
    delay_s = np.array(delay_ms) / 1e3
    truths = {
        "min": delay_s.min(),
        "median": np.median(delay_s),
        "mean": delay_s.mean(),
        "p95": np.percentile(delay_s, 95),
    }
    for name, truth_s in truths.items():
        measured_s = getattr(measures, f"one_way_{name}_s")
        if measured_s is None:
            assert name in (measures.one_way_withheld or "")
            assert error_s > 0.1 * (truth_s - error_s) - 1e-9
        else:
            assert abs(measured_s - truth_s) <= error_s + 1e-9
            assert error_s <= 0.1 * measured_s


def test_results_on_two_clocks_equal_closed_forms() -> None:
    """Delays are 100, 110, 100, 110 ... ms, and pings take 1 ms in each direction."""
    delay_ms = [100.0 + 10 * (n % 2) for n in range(101)]
    sender, receiver = _captures_with_pings([50.0 * n for n in range(101)], delay_ms, (-3600, 0))
    measures = _measure_delays(sender, receiver, transfer(Protocol.UDP))
    assert measures.one_way_withheld is None
    assert measures.one_way_min_s == pytest.approx(0.100, abs=1e-5)
    assert measures.one_way_median_s == pytest.approx(0.100, abs=1e-5)
    assert measures.one_way_mean_s == pytest.approx((51 * 0.1 + 50 * 0.11) / 101, abs=1e-5)
    assert measures.one_way_p95_s == pytest.approx(0.110, abs=1e-5)
    # Half a round trip, and the largest drift of 500 ppm in the 5 s before the pings.
    assert measures.one_way_error_s == pytest.approx(0.001 + 500e-6 * 5.0, abs=0.2e-3)
    assert measures.delay_variation_median_s == 0
    assert measures.delay_variation_p95_s == pytest.approx(0.010)
    assert measures.jitter_s == pytest.approx(0.010 * (1 - (15 / 16) ** 100))
    assert measures.clock_offset_s == pytest.approx(-3600, abs=1e-5)


def test_a_lost_packet_counts_as_infinitely_late_in_the_median_of_all_sent_packets() -> None:
    sender, receiver = _captures_with_pings([50.0 * n for n in range(101)], [100.0 + n for n in range(101)], (0, 0))
    measures = {
        n_sent: _measure_delays(sender, receiver, transfer(Protocol.UDP), n_sent) for n_sent in (101, 151, 202, 203)
    }
    assert all(delays.one_way_median_s == pytest.approx(0.150, abs=1e-5) for delays in measures.values())
    assert measures[101].one_way_median_sent_s == measures[101].one_way_median_s
    assert measures[151].one_way_median_sent_s == pytest.approx(0.175, abs=1e-5)
    assert measures[202].one_way_median_sent_s is measures[203].one_way_median_sent_s is None


def test_reordered_packets_count_and_packets_of_another_transfer_do_not() -> None:
    """The second of four packets arrives last: delays in the order of arrival are 100, 100, 100, 300 ms."""
    sender, receiver = _captures_with_pings([0.0, 10.0, 20.0, 30.0], [100.0, 300.0, 100.0, 100.0], (5.0, 0))
    other_transfer = [
        Frame(START_NS + n * MILLISECOND_NS, packet) for n in range(9) for packet in datagram(900 + n, 3000, port=9)
    ]
    other_arrivals = [replace(frame, time_ns=frame.time_ns + 5_000_000_000) for frame in other_transfer]
    sender, receiver = (
        Packets.concatenated((sender, packets(other_transfer))),
        Packets.concatenated((receiver, packets(other_arrivals))),
    )
    measures = _measure_delays(sender, receiver, transfer(Protocol.UDP))
    assert measures.jitter_s == pytest.approx(0.2 / 16)
    assert measures.delay_variation_p95_s == pytest.approx(0.2 * 0.85), "packets of the other transfer are 5 s late"
    assert measures.one_way_mean_s == pytest.approx(0.150, abs=1e-5)


def test_jitter_equals_the_loop_of_the_rfc() -> None:
    """RFC 3550, appendix A.8."""
    transit_ns = np.random.default_rng(1).integers(-(10**9), 10**9, 300)
    jitter_s = 0.0
    for previous, current in pairwise(transit_ns):
        jitter_s += (abs(current - previous) / 1e9 - jitter_s) / 16
    assert delay.jitter_s(transit_ns) == pytest.approx(jitter_s)
    assert delay.jitter_s(transit_ns[:1]) is None


def test_a_wrong_time_of_a_frame_joined_by_offload_does_not_shift_the_offset() -> None:
    """Three segments from the receiver arrive as one frame, whose time is 3.9 ms early; all others take 2 ms."""
    forward = [(5.0 * n, segment(1, 0, ack=n)) for n in range(6)]
    backward = [(5.0 * n, segment(1000 * n + 1, 1000, back=True)) for n in range(3)]
    joined_by_offload = [(20 + 0.1 * n, segment(3001 + 1000 * n, 1000, back=True)) for n in range(3)]
    sides = (
        [*forward, *((ms + 2, data) for ms, data in backward), (18.3, segment(3001, 3000, back=True))],
        [*((ms + 2, data) for ms, data in forward), *backward, *joined_by_offload],
    )
    sender, receiver = (
        packets(Frame(START_NS + round(ms * MILLISECOND_NS), data) for ms, data in sorted(frames)) for frames in sides
    )
    clocks = delay.clocks_between(sender, receiver, SENDER, RECEIVER)
    assert clocks is not None
    at_ns = np.array([clocks.middle_ns])
    offset_s = clocks.base_ns / 1e9 + clocks.offset_at_s(at_ns)[0]
    assert abs(offset_s) <= clocks.error_s(at_ns)
    assert offset_s == pytest.approx(0, abs=1e-4)


def test_a_tcp_frame_with_offload_arrives_with_its_last_byte() -> None:
    """The segments of a superframe arrive separately; a segment that was sent twice is ambiguous."""
    isn = 2**32 - 1500
    sent_frames = [(0, segment(isn, 0, flags=2)), (10, segment(isn + 1, 3000)), (20, segment(isn + 3001, 1000))]
    sent_frames += [(60, segment(isn + 3001, 1000)), (70, segment(isn + 4001, 500))]
    reverse = segment(8, 0, back=True)
    arrivals = [(1, sent_frames[0][1]), *((110 + 5 * n, segment(isn + 1 + 1000 * n, 1000)) for n in range(3))]
    arrivals += [(150, segment(isn + 3001, 1000)), (200, sent_frames[-1][1])]
    ack = segment(isn + 1, 0)
    sender, receiver = (
        packets(Frame(START_NS + ms * MILLISECOND_NS, data) for ms, data in frames)
        for frames in (
            [*sent_frames, (3, reverse), (4, ack), (6, segment(9, 0, back=True))],
            [*arrivals, (2, reverse), (5, ack), (5, segment(9, 0, back=True))],
        )
    )
    measures = _measure_delays(sender, receiver, transfer(Protocol.TCP))
    assert measures.one_way_error_s == pytest.approx(0.001, abs=0.2e-3)
    assert measures.one_way_min_s == pytest.approx(0.110, abs=1e-5), "the delay of the last byte of the superframe"
    assert measures.one_way_mean_s == pytest.approx((0.110 + 0.130) / 2, abs=1e-5)


def test_a_lost_tcp_frame_does_not_match_a_retransmission_in_a_larger_frame() -> None:
    """Two segments are lost and sent again as one superframe; they arrive separately 10 ms later."""
    sent_frames = [
        (0, segment(0, 0, flags=2)),
        (10, segment(1, 1000)),
        (12, segment(1001, 1000)),
        (14, segment(2001, 1000)),
    ]
    arrivals = [(10, sent_frames[0][1]), (24, sent_frames[3][1]), (310, sent_frames[1][1]), (310, sent_frames[2][1])]
    sent_frames += [(300, segment(1, 2000))]
    sender, receiver = (
        packets(Frame(START_NS + ms * MILLISECOND_NS, data) for ms, data in frames)
        for frames in (sent_frames, arrivals)
    )
    frames = delay.tcp_pairs(tcp.match_transfer(sender, receiver, transfer(Protocol.TCP)))
    assert ((frames.receiver_ns - frames.sender_ns) / MILLISECOND_NS).tolist() == [10, 10]


Change = Callable[[Packets, Packets], tuple[Packets, Packets]]

WITHHELD: dict[str, Change] = {
    "no packet of the transfer is in both captures": lambda sender, receiver: (sender, receiver.where(slice(0, 0))),
    "no packet from receiver to sender is in both captures": lambda sender, receiver: (
        sender.where(sender.are_from(SENDER)),
        receiver,
    ),
    "a capture lacks times": lambda sender, receiver: (
        replace(sender, time_ns=np.full(len(sender), NO_TIME)),
        receiver,
    ),
    delay.UNSTEADY: lambda sender, receiver: (
        sender,
        replace(
            receiver, time_ns=receiver.time_ns + np.where(np.arange(len(receiver)) < len(receiver) - 6, 0, -(10**9))
        ),
    ),
    delay.SINGLE_PACKET: lambda sender, receiver: (
        sender.where(sender.are_from(SENDER) | (np.arange(len(sender)) == len(sender) - 1)),
        receiver,
    ),
    "the error is above a tenth of: min, median, mean, p95": lambda sender, receiver: (sender, receiver),
}


@pytest.mark.parametrize("reason", WITHHELD)
def test_unknown_values_are_missing_with_a_reason(reason: str) -> None:
    sender, receiver = _captures_with_pings([0.0, 1.0, 2.0], [1.0, 1.0, 1.5], (12.0, 0))
    measures = _measure_delays(*WITHHELD[reason](sender, receiver), transfer(Protocol.UDP))
    assert measures.one_way_withheld == reason
    assert (
        measures.one_way_min_s
        is measures.one_way_median_s
        is measures.one_way_mean_s
        is measures.one_way_p95_s
        is None
    )
    has_offset = reason.startswith("the error")
    assert (measures.one_way_error_s is not None) == (measures.clock_offset_s is not None) == has_offset
    # Values that need no common clock are present if there are packets and times, and both clocks are steady.
    assert (measures.jitter_s is None) == (reason.startswith(("no packet of", "no offset")) or "times" in reason)
