"""A sender on a scripted wire: times of transmissions and window sizes, compared with results computed by hand."""

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.packets import Packet
from sim_backends.network.tcp.connection import Tcp, TcpSample
from sim_backends.network.tcp.segments import Segment
from sim_backends.network.tcp.tcp_options import Congestion, TcpOptions
from sim_backends.network.wire import IpPacket
from tests.helpers.scripted_wire import Script, ScriptedWire, lose_packets

MS = 1_000_000
SECOND = 1000 * MS
DELAY_NS = 10 * MS
ROUND_TRIP_NS = 2 * DELAY_NS
MSS = TcpOptions().segment_bytes
ACK_EACH_SEGMENT = TcpOptions(segments_per_ack=1, congestion="newreno")


class Transfer:
    """Messages of a full segment each, all written at the start, and their results."""

    def __init__(
        self,
        segments: int,
        options: TcpOptions,
        *,
        script: Script | None = None,
        rate_bit_s: int | None = None,
        delay_ns: int = DELAY_NS,
        until_ns: int | None = None,
    ) -> None:
        self.samples: list[TcpSample] = []
        self.wire = ScriptedWire(delay_ns, rate_bit_s=rate_bit_s, script=script)
        transport = self.wire.transports["tcp"] = Tcp(self.wire, options, log=self.samples.append)
        for number in range(segments):
            transport.send(Packet(number, "a", "b", MSS, ("f", number), 0, 0, "tcp"))
        self.wire.run(until_ns)

    def transmissions(self, *, earlier: int | None = None) -> list[tuple[int, int]]:
        """Return time and number of each transmission of a data segment.

        Args:
            earlier: Number of earlier transmissions of the same segment; None for all transmissions.
        """
        return [
            (transmission.at_ns, transmission.packet.body[1].number)
            for transmission in self.wire.transmitted
            if transmission.packet.body[1].length
            and earlier in {None, transmission.packet.body[1].earlier_transmissions}
        ]

    def events(self, event: str) -> list[TcpSample]:
        return [sample for sample in self.samples if sample.event == event]


def losing_data(numbers: Collection[int], *, times: int = 1) -> Script:
    """Return a script that loses the first transmissions of these segments of the stream."""

    def script(packet: IpPacket, *_: object) -> Sequence[int]:
        segment: Segment = packet.body[1]
        return () if segment.length and segment.number in numbers and segment.earlier_transmissions < times else (0,)

    return script


@pytest.mark.parametrize("segments_per_ack", [1, 2])
@pytest.mark.parametrize("congestion", ["newreno", "cubic"])
def test_slow_start_doubles_the_window_per_round_trip(segments_per_ack: int, congestion: str) -> None:
    options = TcpOptions(segments_per_ack=segments_per_ack, congestion=congestion)  # type: ignore[arg-type]
    transfer = Transfer(2000, options)
    segments_per_round = Counter(at_ns for at_ns, _ in transfer.transmissions())
    # SYN and SYN-ACK take the first round trip; then 10, 20, 40, ... (RFC 6928, and RFC 5681 with all bytes counted).
    doubled_windows = {(1 + number) * ROUND_TRIP_NS: 10 << number for number in range(7)}
    assert segments_per_round == doubled_windows | {8 * ROUND_TRIP_NS: 2000 - sum(doubled_windows.values())}


def test_reno_counts_acks_if_configured() -> None:
    # RFC 5681 increases the window by a segment per ACK: with an ACK for every second segment, by half.
    options = TcpOptions(initial_window_segments=16, bytes_counted_segments=1)
    transfer = Transfer(1000, options, until_ns=5 * ROUND_TRIP_NS)
    segments_per_round = Counter(at_ns for at_ns, _ in transfer.transmissions())
    assert list(segments_per_round.values())[:4] == [16, 24, 36, 54]


def test_a_transfer_uses_the_full_rate_of_a_link() -> None:
    transfer = Transfer(3000, TcpOptions(), rate_bit_s=20_000_000)
    # 20 Mbit/s for 20 ms are 33 segments; slow start is over long before the thousandth.
    arrivals_ns = list(transfer.wire.delivered.values())
    assert arrivals_ns[-1] - arrivals_ns[1000] == 1999 * 1500 * 8 * 50


@pytest.mark.parametrize("congestion", ["newreno", "cubic"])
@pytest.mark.parametrize(
    "lost_numbers",
    [{70}, {70, 71}, {70, 90}, set(range(70, 100)), set(range(70, 146, 2)), set(range(70, 108)), {70, 147}],
)
def test_losses_in_a_window_are_repaired_in_one_round_trip(congestion: str, lost_numbers: set[int]) -> None:
    # The segments 70 to 149 are one window, sent together; so are the ACKs of those that arrive. RFC 6937 sends no
    # more than arrives after the first two, so all of half a window but two can be repaired in that time.
    options = TcpOptions(segments_per_ack=1, congestion=congestion)  # type: ignore[arg-type]
    transfer = Transfer(150, options, script=losing_data(lost_numbers))
    sent_ns = 4 * ROUND_TRIP_NS
    assert [at_ns for at_ns, number in transfer.transmissions(earlier=0) if number in lost_numbers] == [
        sent_ns
    ] * len(lost_numbers)
    assert transfer.transmissions(earlier=1) == [(sent_ns + ROUND_TRIP_NS, number) for number in sorted(lost_numbers)]
    assert len(transfer.transmissions()) == 150 + len(lost_numbers)
    assert len(transfer.events("loss")) == 1
    assert not transfer.events("timeout")
    assert transfer.wire.delivered[149] == sent_ns + ROUND_TRIP_NS + DELAY_NS
    # The flight was 80 segments minus those acknowledged before: the window is reduced to half, or to 7 tenths.
    flight = 80 - (min(lost_numbers) - 70)
    assert transfer.events("loss")[0].window_bytes == flight * MSS * {"newreno": 5, "cubic": 7}[congestion] // 10


def test_limited_transmit_sends_two_segments_before_a_loss_is_detected() -> None:
    # RFC 3042: the first of ten segments is lost; each of the first two ACKs of others allows one more.
    transfer = Transfer(100, ACK_EACH_SEGMENT, script=losing_data({0}), rate_bit_s=12_000_000)
    acks = [transmission.packet for transmission in transfer.wire.transmitted if transmission.packet.body[1].sacks]
    assert [packet.size_bytes for packet in acks[:2]] == [64, 64]
    # SYN and SYN-ACK take 40 us each in addition to the delays, an ACK of 52 bytes precedes the data, a segment takes
    # 1 ms and an ACK of 64 bytes 64 * 8 / 12 us.
    start_ns = ROUND_TRIP_NS + 80_000
    first_ack_ns = start_ns + 34_667 + 2 * MS + DELAY_NS + 42_667 + DELAY_NS
    ack_times_ns = [first_ack_ns + number * MS for number in range(3)]
    sent_segments = [(at_ns, number) for at_ns, number in transfer.transmissions() if at_ns > start_ns][:3]
    assert sent_segments == list(zip(ack_times_ns, [10, 11, 0], strict=True))
    # These two segments do not count when the window is halved (RFC 5681, 3.2, step 2).
    assert transfer.events("loss")[0].window_bytes == 5 * MSS


def test_a_segment_overtaken_by_two_others_is_not_sent_again() -> None:
    # Two later segments overtake segment 20; RFC 5681 considers it lost only after three.
    def script(packet: IpPacket, *_: object) -> Sequence[int]:
        return (2 * MS + 1,) if packet.body[1].number == 20 and packet.body[1].length else (0,)

    transfer = Transfer(60, ACK_EACH_SEGMENT, script=script, rate_bit_s=12_000_000)
    assert len(transfer.transmissions()) == 60
    assert not transfer.events("loss")


@pytest.mark.parametrize("times", [1, 2, 3, 5])
def test_the_last_segment_is_retransmitted_with_exponential_backoff(times: int) -> None:
    transfer = Transfer(5, TcpOptions(), script=losing_data({4}, times=times))
    assert transfer.wire.delivered[3] == ROUND_TRIP_NS + DELAY_NS
    # The timer of 200 ms starts with the last ACK, which the fourth segment, as the second of two, causes
    # immediately.
    last_ack_ns = 2 * ROUND_TRIP_NS
    retransmissions_ns = [last_ack_ns + (2**count - 1) * 200 * MS for count in range(1, times + 1)]
    assert [at_ns for at_ns, number in transfer.transmissions() if number == 4][1:] == retransmissions_ns
    assert transfer.wire.delivered[4] == retransmissions_ns[-1] + DELAY_NS
    assert [sample.window_bytes for sample in transfer.events("timeout")] == [MSS] * times


def test_after_a_timeout_slow_start_retransmits_only_missing_segments() -> None:
    # All segments of a window except the last two are lost, so fewer than three later segments indicate the loss.
    lost_numbers = set(range(30, 68))
    transfer = Transfer(70, ACK_EACH_SEGMENT, script=losing_data(lost_numbers))
    assert len(transfer.events("timeout")) == 1
    assert not transfer.events("loss")
    assert Counter(number for _, number in transfer.transmissions()) == Counter(
        {n: 1 + (n in lost_numbers) for n in range(70)}
    )
    start_ns = transfer.events("timeout")[0].at_ns
    segments_per_round = Counter(
        (at_ns - start_ns) // ROUND_TRIP_NS for at_ns, _ in transfer.transmissions(earlier=1)
    )
    assert segments_per_round == {0: 1, 1: 2, 2: 4, 3: 8, 4: 16, 5: 7}


def test_a_repeatedly_lost_segment_waits_for_another_timeout() -> None:
    # RFC 6675, 5.1: after a timeout no loss is detected by SACK until all data sent before is acknowledged.
    lost_numbers = set(range(30, 68))

    def script(packet: IpPacket, *_: object) -> Sequence[int]:
        segment: Segment = packet.body[1]
        times = 2 if segment.number == 31 else 1 if segment.number in lost_numbers else 0
        return () if segment.length and segment.earlier_transmissions < times else (0,)

    transfer = Transfer(70, ACK_EACH_SEGMENT, script=script)
    assert len(transfer.events("timeout")) == 2
    assert not transfer.events("loss")
    assert max(Counter(number for _, number in transfer.transmissions(earlier=1)).values()) == 1


@pytest.mark.parametrize("congestion", ["newreno", "cubic-rfc9438"])
def test_after_a_timeout_bytes_reported_by_earlier_sacks_do_not_open_the_window(
    congestion: Literal["newreno", "cubic-rfc9438"],
) -> None:
    """RFC 3465, 2.3: the ACK that fills the gap covers 20 segments, of which 19 had left the network before."""
    options = replace(ACK_EACH_SEGMENT, congestion=congestion, initial_window_segments=20)
    transfer = Transfer(200, options, script=losing_data({0}, times=2))
    (timeout,) = transfer.events("timeout")
    first_ack = next(sample for sample in transfer.events("ack") if sample.at_ns > timeout.at_ns)
    assert (timeout.window_bytes, first_ack.window_bytes) == (MSS, 2 * MSS)


def test_only_the_first_timeout_of_several_lowers_the_threshold() -> None:
    # RFC 5681, 3.1: half of the ten segments in flight at the first timeout, not of the one that is sent again.
    transfer = Transfer(10, ACK_EACH_SEGMENT, script=losing_data(range(10), times=3))
    assert [sample.threshold_bytes for sample in transfer.events("timeout")[:3]] == [5 * MSS] * 3


def test_a_filled_gap_is_acknowledged_immediately() -> None:
    # RFC 5681, 4.2, even for a single segment.
    transfer = Transfer(5, TcpOptions(), script=losing_data({0}))
    assert [transmission.at_ns for transmission in transfer.wire.transmitted][-1] == transfer.wire.delivered[4]


def test_an_ack_of_two_segments_echoes_the_timestamp_of_the_first() -> None:
    # RFC 7323, 4.2 (1): the measured round trip includes the whole ACK delay, here 30 ms.
    samples: list[TcpSample] = []
    wire = ScriptedWire(DELAY_NS)
    wire.transports["tcp"] = Tcp(wire, log=samples.append)
    for number, at_ns in enumerate([0, 30 * MS]):
        wire.send_at(SECOND + at_ns, Packet(number, "a", "b", 100, ("f", number), 0, 0, "tcp"))
    wire.run()
    # The first message waits for the handshake: it is sent 20 ms later, 10 ms before the second.
    assert samples[-1].round_trip_ns == (7 * 20 * MS + (10 + 20) * MS) // 8


def test_an_ack_is_delayed_by_40_ms_or_until_a_second_segment() -> None:
    wire = ScriptedWire(DELAY_NS)
    transport = wire.transports["tcp"] = Tcp(wire)
    times_ns = [0, 300 * MS, 300 * MS + 5 * MS]
    for number, at_ns in enumerate(times_ns):
        wire.send_at(at_ns, Packet(number, "a", "b", 100, ("f", number), at_ns, at_ns, "tcp"))
    wire.run()
    acks_ns = [transmission.at_ns for transmission in wire.transmitted if transmission.packet.source == "b"][1:]
    assert acks_ns == [3 * DELAY_NS + 40 * MS, times_ns[2] + DELAY_NS]
    assert transport is wire.transports["tcp"]


def test_a_measured_round_trip_includes_the_ack_delay() -> None:
    transfer = Transfer(1, TcpOptions())
    # From the handshake 20 ms, then a sample of 60 ms: 7/8 20 + 1/8 60 (RFC 6298, RFC 7323).
    assert transfer.samples[-1].round_trip_ns == 25 * MS


def test_nagle_delays_small_segments_while_others_are_in_flight() -> None:
    def arrivals_ns(options: TcpOptions) -> list[int]:
        wire = ScriptedWire(DELAY_NS)
        wire.transports["tcp"] = Tcp(wire, options)
        for number, at_ns in enumerate([0, 500 * MS, 501 * MS, 502 * MS]):
            wire.send_at(at_ns, Packet(number, "a", "b", 100, ("f", number), at_ns, at_ns, "tcp"))
        wire.run()
        return list(wire.delivered.values())[1:]

    assert arrivals_ns(TcpOptions()) == [510 * MS, 511 * MS, 512 * MS]
    # The ACK of the first is delayed by 40 ms; then the other two are sent together.
    assert arrivals_ns(TcpOptions(nagle=True)) == [510 * MS, 570 * MS, 570 * MS]


def test_the_receive_window_limits_the_bytes_in_flight() -> None:
    transfer = Transfer(500, TcpOptions(receive_window_bytes=25 * MSS))
    segments_per_round = Counter(at_ns for at_ns, _ in transfer.transmissions())
    # 25, minus one segment that waits for a second one before it is acknowledged.
    assert list(segments_per_round.values())[:5] == [10, 20, 25, 24, 24]


@pytest.mark.parametrize(("restart", "burst"), [(True, 10), (False, 40)])
def test_the_window_is_reset_after_an_idle_period(*, restart: bool, burst: int) -> None:
    transfer = Transfer(70, TcpOptions(restart_after_idle=restart))
    wire = transfer.wire
    wire.run(5 * SECOND)
    for number in range(70, 270):
        wire.transports["tcp"].send(Packet(number, "a", "b", MSS, ("f", number), 0, 0, "tcp"))
    wire.run()
    segments_per_round = Counter(at_ns for at_ns, _ in transfer.transmissions())
    assert segments_per_round[5 * SECOND] == burst


def test_the_window_does_not_grow_if_the_program_does_not_use_it() -> None:
    wire = ScriptedWire(DELAY_NS)
    samples: list[TcpSample] = []
    wire.transports["tcp"] = Tcp(wire, log=samples.append)
    for number in range(500):
        wire.send_at(number * 10 * MS, Packet(number, "a", "b", 100, ("f", number), 0, 0, "tcp"))
    wire.run()
    assert {sample.window_bytes for sample in samples} == {10 * MSS}


@pytest.mark.parametrize(("lost_syns", "window"), [(1, 10), (2, 1)])
def test_more_than_one_lost_syn_reduces_the_initial_window_to_one_segment(lost_syns: int, window: int) -> None:
    transfer = Transfer(50, TcpOptions(), script=lose_packets({"a": range(lost_syns)}))
    assert (
        Counter(at_ns for at_ns, _ in transfer.transmissions())[(2**lost_syns - 1) * SECOND + ROUND_TRIP_NS] == window
    )


@pytest.mark.parametrize("period", [300, 1200])
def test_renos_sawtooth_has_the_throughput_of_mathis(period: int) -> None:
    # Mathis, Semke, Mahdavi, Ott, "The macroscopic behavior of the TCP congestion avoidance algorithm", CCR 27(3),
    # 1997: sqrt(3/2) / sqrt(p) segments per round trip. The result is up to a tenth less, because windows are whole
    # segments and do not grow in the round trip of a recovery, which is one of about W/2 + 1.
    def script(packet: IpPacket, *_: object) -> Sequence[int]:
        segment: Segment = packet.body[1]
        is_first_transmission = segment.length and not segment.earlier_transmissions
        return () if is_first_transmission and segment.number % period == period - 1 else (0,)

    expected = math.sqrt(1.5 * period)
    options = replace(ACK_EACH_SEGMENT, receive_window_bytes=round(2 * expected) * MSS)
    transfer = Transfer(19 * period, options, script=script)
    start_ns, end_ns = (transfer.wire.delivered[losses * period] for losses in (6, 18))
    per_round_trip = 12 * period * ROUND_TRIP_NS / (end_ns - start_ns)
    assert 0.9 * expected < per_round_trip < expected


@pytest.mark.parametrize("congestion", ["cubic", "cubic-rfc9438"])
def test_cubic_follows_its_curve_with_acks_over_a_link(congestion: Literal["cubic", "cubic-rfc9438"]) -> None:
    # The receive window limits the window to 200 segments until the loss.
    options = TcpOptions(segments_per_ack=1, receive_window_bytes=200 * MSS, congestion=congestion)
    delay_ns, until_ns = 50 * MS, 6 * SECOND
    transfer = Transfer(20_000, options, script=losing_data({1500}), delay_ns=delay_ns, until_ns=until_ns)
    (loss,) = transfer.events("loss")
    assert loss.window_bytes == 140 * MSS
    windows_after_loss = {
        sample.at_ns: sample.window_bytes / MSS for sample in transfer.samples if sample.at_ns > loss.at_ns
    }
    start_ns = min(at_ns for at_ns, window in windows_after_loss.items() if window > 140)
    assert start_ns <= loss.at_ns + 4 * delay_ns
    plateau_s = (0.3 * 200 / 0.4) ** (1 / 3)
    for at_ns, window in windows_after_loss.items():
        # The ACKs of a round trip move the window to the value of the curve one round trip later (RFC 9438, 4.2).
        at_s = (at_ns + 2 * delay_ns - start_ns) / SECOND
        if 1 < at_s < plateau_s - 0.5:
            assert window == pytest.approx(
                0.4 * (at_s - plateau_s) ** 3 + 200, rel=0.01 if congestion == "cubic-rfc9438" else 0.02
            )


def integer_sawtooth(period: int) -> float:
    """Return segments per round trip of a window that grows by 8/15 of a segment per round trip, with factor 0.7."""
    window, growth, per_round_trip, rounds = 10, 0.0, 0, 0
    for _ in range(100):
        acknowledged_segments = 0
        while acknowledged_segments < period:
            acknowledged_segments += window
            rounds += 1
            growth += 8 / 15
            if growth >= 1:
                window, growth = window + 1, growth - 1
        # The window does not grow in the round trip of the recovery, and is a whole number of segments.
        window, growth = math.floor(0.7 * window), 0.0
        per_round_trip, rounds = per_round_trip + acknowledged_segments + window, rounds + 1
    return per_round_trip / rounds


@pytest.mark.parametrize("period", [30, 100, 200])
def test_linux_cubic_has_the_throughput_of_its_reno_estimate(period: int) -> None:
    def script(packet: IpPacket, *_: object) -> Sequence[int]:
        segment: Segment = packet.body[1]
        is_first_transmission = segment.length and not segment.earlier_transmissions
        return () if is_first_transmission and segment.number % period == period - 1 else (0,)

    transfer = Transfer(100 * period, TcpOptions(segments_per_ack=1), script=script, delay_ns=20 * MS)
    start_ns, end_ns = (transfer.wire.delivered[losses * period] for losses in (20, 90))
    per_round_trip = 70 * period * 40 * MS / (end_ns - start_ns)
    # The estimate is updated every 1/32 s, three quarters of the round trip here, so each step is late.
    assert 0.75 < per_round_trip / integer_sawtooth(period) < 0.95


def test_linux_detects_a_lost_retransmission_within_a_round_trip() -> None:
    # RFC 8985: a segment that was sent later has arrived, a round trip later. RFC 6675 waits for the timer.
    transfer = Transfer(2000, TcpOptions(segments_per_ack=1), script=losing_data({70}, times=3))
    assert not transfer.events("timeout")
    assert len(transfer.events("loss")) == 1
    sent_ns = [at_ns for at_ns, number in transfer.transmissions() if number == 70]
    assert len(sent_ns) == 4
    assert all(later - earlier <= 2 * ROUND_TRIP_NS for earlier, later in pairwise(sent_ns))


def test_linux_detects_a_loss_by_two_later_segments_after_a_quarter_of_a_round_trip() -> None:
    # RFC 8985, 6.2: the reordering window is a quarter of the minimum round trip while fewer than three have arrived.
    transfer = Transfer(10, TcpOptions(segments_per_ack=1), script=losing_data({7}))
    sent_ns = [at_ns for at_ns, number in transfer.transmissions() if number == 7]
    assert sent_ns == [ROUND_TRIP_NS, 2 * ROUND_TRIP_NS + ROUND_TRIP_NS // 4]
    assert not transfer.events("timeout")


@given(lost_numbers=st.sets(st.integers(0, 90), max_size=30), control=st.sampled_from(get_args(Congestion)))
def test_without_reordering_only_lost_segments_are_sent_again(lost_numbers: set[int], control: Congestion) -> None:
    options = TcpOptions(segments_per_ack=1, congestion=control)
    transfer = Transfer(100, options, script=losing_data(lost_numbers), rate_bit_s=20_000_000)
    assert {number for _, number in transfer.transmissions(earlier=1)} == lost_numbers
