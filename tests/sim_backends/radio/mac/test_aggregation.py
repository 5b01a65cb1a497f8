"""A-MPDU: building of aggregates, Block Ack sessions, and goodput compared with a closed form and with ns-3."""

from collections import deque
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typing_extensions import override

from sim_backends.radio.core.links import RETRIES_EXHAUSTED
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.mac.aggregation import (
    AMPDU_LIMITS,
    QOS_HEADER_BYTES,
    AmpduLimits,
    BlockAckSession,
    remove_frames,
)
from sim_backends.radio.mac.contention import CCA_TIME_NS
from sim_backends.radio.mac.frames import Frame, TransmissionAttempt
from sim_backends.radio.phy.high_throughput import format_modes
from sim_backends.radio.phy.modes import CW_MIN, SHORT_RETRY_LIMIT, SLOT_NS, WifiMode, response_ns
from sim_backends.radio.rate_control.rate_control import FixedRate
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import HEADERS_BYTES, FixedPowers, saturate

HT20 = format_modes("HT", "2.4 GHz", 20, 1, 800)
HT20_7 = HT20[7]
HT40_7 = format_modes("HT", "2.4 GHz", 40, 1, 800)[7]
VHT80_9 = format_modes("VHT", "5 GHz", 80, 2, 400)[9]
HE80_11 = format_modes("HE", "5 GHz", 80, 2, 800)[11]
SUBFRAME_BYTES = 4 + 1028 + QOS_HEADER_BYTES


def frames(count: int, *, size_bytes: int = 1028, receiver: int = 1) -> deque[Frame[int]]:
    return deque(
        Frame(number, size_bytes, "a", receiver, (), True, ("a", number), queued_ns=0) for number in range(count)
    )


def session(mode: WifiMode) -> BlockAckSession[int]:
    return BlockAckSession(AMPDU_LIMITS[mode.phy_format])


class AggregatingPowers(FixedPowers):
    """Stations that aggregate frames and have the inter-frame space of best effort."""

    def __init__(self, names: Sequence[str], mode: WifiMode, without_link: Sequence[tuple[str, str]] = ()) -> None:
        super().__init__(names, mode, without_link=without_link)
        self.band = mode.band
        self.mode = mode

    @override
    def ifs_ns(self, station: int) -> int:
        return self.band.best_effort_aifs_ns

    @override
    def ampdu_limits(self, transmitter: int, receiver: int) -> AmpduLimits:
        return AMPDU_LIMITS[self.mode.phy_format]


def test_an_aggregate_is_limited_by_its_bytes_its_duration_and_the_window() -> None:
    # 65,535 bytes hold 61 subframes of 1070 bytes, padded to 1072: 61 * 1072 = 65,392.
    assert len(session(HT40_7).build_aggregate(frames(100), HT40_7).frames) == 61
    assert len(session(VHT80_9).build_aggregate(frames(100), VHT80_9).frames) == 64
    assert len(session(HE80_11).build_aggregate(frames(400), HE80_11).frames) == 256
    slow_aggregate = session(HT20[0]).build_aggregate(frames(100), HT20[0])
    assert (
        HT20[0].airtime_ns(slow_aggregate.size_bytes)
        <= 5_484_000
        < HT20[0].airtime_ns(slow_aggregate.size_bytes + SUBFRAME_BYTES + 2)
    )


def test_a_single_frame_is_answered_by_an_ack_and_has_a_delimiter_only_in_vht_and_he() -> None:
    for mode, size_bytes in ((HT20_7, 1028 + QOS_HEADER_BYTES), (VHT80_9, SUBFRAME_BYTES)):
        single_frame = session(mode).build_aggregate(frames(1), mode)
        assert (single_frame.size_bytes, single_frame.response_bytes) == (size_bytes, 14)
    assert session(VHT80_9).build_aggregate(frames(2), VHT80_9).response_bytes == 32
    assert session(HE80_11).build_aggregate(frames(2), HE80_11).response_bytes == 56


def test_each_subframe_but_the_last_is_padded_to_four_bytes() -> None:
    padded_bytes, last_bytes = SUBFRAME_BYTES + 2, SUBFRAME_BYTES
    assert SUBFRAME_BYTES % 4 == 2
    assert session(VHT80_9).build_aggregate(frames(3), VHT80_9).size_bytes == 2 * padded_bytes + last_bytes


def test_a_recipient_ignores_frames_that_it_has_received() -> None:
    agreement = session(VHT80_9)
    first, second, third = agreement.build_aggregate(frames(3), VHT80_9).frames
    assert agreement.receive([second]) == []
    assert agreement.receive([first]) == [first, second]
    assert agreement.receive([first, second]) == []
    assert agreement.receive([third, first]) == [third]


def test_only_frames_to_the_receiver_of_the_first_are_aggregated() -> None:
    queue = deque(frame for pair in zip(frames(5), frames(5, receiver=2), strict=True) for frame in pair)
    assert {frame.receiver for frame in session(HT20_7).build_aggregate(queue, HT20_7).frames} == {1}


def test_the_window_starts_at_the_oldest_unacknowledged_frame() -> None:
    queue, agreement = frames(100), session(VHT80_9)
    first_aggregate = agreement.build_aggregate(queue, VHT80_9)
    remove_frames(queue, set(first_aggregate.frames[1:]))
    second_aggregate = agreement.build_aggregate(queue, VHT80_9)
    assert [frame.sequence for frame in second_aggregate.frames] == [0], (
        "sequence numbers 1 to 63 fill the rest of the window"
    )
    remove_frames(queue, set(first_aggregate.frames[:1]))
    assert [frame.sequence for frame in agreement.build_aggregate(queue, VHT80_9).frames] == list(range(64, 100))


@given(st.lists(st.sets(st.integers(0, 19)), max_size=12), st.sets(st.integers(0, 19)))
def test_a_recipient_delivers_each_frame_once_and_in_order(
    decoded_numbers: list[set[int]], skipped_numbers: set[int]
) -> None:
    agreement = session(VHT80_9)
    sent_frames = list(agreement.build_aggregate(frames(20), VHT80_9).frames)
    delivered_frames = [
        frame
        for numbers in decoded_numbers
        for frame in agreement.receive([sent_frames[number] for number in numbers])
    ]
    assert [frame.sequence for frame in delivered_frames] == list(range(len(delivered_frames))), (
        "there is no gap before a frame is skipped"
    )
    delivered_frames += agreement.skip(
        [frame for frame in sent_frames if frame.sequence in skipped_numbers and not frame.is_received]
    )
    remaining_frames = [
        frame for frame in sent_frames if not frame.is_received and frame.sequence not in skipped_numbers
    ]
    delivered_frames += agreement.receive(remaining_frames)
    received_numbers = set().union(*decoded_numbers) | {frame.sequence for frame in remaining_frames}
    assert [frame.sequence for frame in delivered_frames] == sorted(received_numbers)


@pytest.mark.parametrize("mode", [HT20_7, VHT80_9, HE80_11], ids=lambda mode: mode.name)
def test_goodput_of_one_station_equals_the_closed_form(mode: WifiMode) -> None:
    """Full aggregates, mean backoff of 7.5 slots: n payloads per AIFS, backoff, aggregate, SIFS and Block Ack."""
    log: list[TransmissionAttempt] = []
    goodput = saturate(AggregatingPowers("ab", mode), "a", "b", seconds=0.5, queued=600, log=log)["a"]
    queue = frames(600)
    aggregate = session(mode).build_aggregate(queue, mode)
    exchange_ns = (
        mode.band.best_effort_aifs_ns
        + CW_MIN / 2 * SLOT_NS
        + mode.airtime_ns(aggregate.size_bytes)
        + mode.band.sifs_ns
        + response_ns(mode, aggregate.response_bytes)
    )
    assert goodput == pytest.approx(len(aggregate.frames) * 8000 / exchange_ns * 1e9, rel=0.02)
    assert {attempt.size_bytes for attempt in log if attempt.number} == {1028 + QOS_HEADER_BYTES}


@pytest.mark.parametrize("stations", [2, 5, 10, 20])
def test_contending_stations_follow_bianchi_with_aggregates(stations: int) -> None:
    """Bianchi, IEEE JSAC 18:535 (2000), eq. 7 to 13, with an A-MPDU as the payload and a Block Ack as its answer.

    A collision lasts for the aggregate and the time until the sender senses a missing Block Ack.
    """
    mode = HT20_7
    names = [f"s{number}" for number in range(stations)]
    goodput = sum(saturate(AggregatingPowers([*names, "r"], mode), names, "r", seconds=4.0, queued=150).values())
    assert goodput == pytest.approx(bianchi_bit_s(mode, stations), rel=0.05)


def bianchi_bit_s(mode: WifiMode, stations: int) -> float:
    window, stages = CW_MIN + 1, 6
    low, high = 0.0, 1.0
    for _ in range(60):
        tau = (low + high) / 2
        collision = 1 - (1 - tau) ** (stations - 1)
        doubling = sum((2 * collision) ** stage for stage in range(stages))
        high, low = (high, tau) if tau < 2 / (1 + window + collision * window * doubling) else (tau, low)
    aggregate = session(mode).build_aggregate(frames(100), mode)
    airtime_ns, aifs_ns = mode.airtime_ns(aggregate.size_bytes), mode.band.best_effort_aifs_ns
    success_ns = airtime_ns + mode.band.sifs_ns + response_ns(mode, aggregate.response_bytes) + aifs_ns
    collision_ns = airtime_ns + mode.band.sifs_ns + SLOT_NS + 20_000 + aifs_ns
    idle, single = (1 - tau) ** stations, stations * tau * (1 - tau) ** (stations - 1)
    slot_ns = idle * SLOT_NS + single * success_ns + (1 - idle - single) * collision_ns
    assert CCA_TIME_NS < SLOT_NS
    return single * len(aggregate.frames) * 8000 / slot_ns * 1e9


# ns-3 3.37, `benchmarks.high_throughput_vs_ns3`: payloads of 1000 bytes, Mbit/s.
@pytest.mark.parametrize(("stations", "ns3_mbit_s"), [(1, 58.50), (5, 49.07)])
def test_goodput_is_within_five_percent_of_ns3(stations: int, ns3_mbit_s: float) -> None:
    names = [f"s{number}" for number in range(stations)]
    goodput = sum(saturate(AggregatingPowers([*names, "r"], HT20_7), names, "r", seconds=2.0, queued=150).values())
    assert goodput / 1e6 == pytest.approx(ns3_mbit_s, rel=0.05)


def test_lost_frames_are_sent_again_within_later_aggregates_and_arrive_in_order() -> None:
    """At an SNR that corrupts a tenth of the frames, all frames arrive, once and in order."""
    channel = AggregatingPowers("ab", HT20_7)
    channel.rows = [[power * 1e-9 * 10**2.36 / 1e-4 for power in row] for row in channel.rows]
    channel.sensitivity_mw = [1e-9] * 2
    wifi: Wifi[int] = Wifi(channel, 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    for number in range(500):
        wifi.send(0, "a", number, 1000 + HEADERS_BYTES, "b")
    arrived_numbers = [payload for _, _, payload, _, _ in wifi.deliveries(10**10)]
    attempts = [attempt for attempt in log if attempt.number]
    assert arrived_numbers == list(range(500))
    retries = [attempt for attempt in attempts if attempt.number > 1]
    assert 0.02 < len(retries) / len(attempts) < 0.5
    first_starts_ns = {attempt.start_ns for attempt in attempts if attempt.number == 1}
    assert any(attempt.start_ns in first_starts_ns for attempt in retries), "sent again together with new frames"


def test_frames_to_a_silent_receiver_are_dropped_after_the_retry_limit() -> None:
    channel = AggregatingPowers("ab", HT20_7, without_link=[("a", "b")])
    wifi: Wifi[int] = Wifi(channel, 1)
    losses: list[tuple[int, str, str]] = []
    wifi.log_losses(lambda _, payload, station, reason: losses.append((payload, station, reason)))
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    for number in range(3):
        wifi.send(0, "a", number, 1028, "b")
    assert wifi.deliveries(10**10) == []
    assert losses == [(number, "b", RETRIES_EXHAUSTED) for number in range(3)]
    assert {attempt.number for attempt in log} == set(range(1, SHORT_RETRY_LIMIT + 1))
    counters = wifi.counters()["a", "b"]
    assert (counters.sent, counters.lost, counters.delivered) == (3, 3, 0)


def test_frames_are_sent_again_until_their_block_ack_arrives() -> None:
    """Without a Block Ack, frames are delivered once and dropped later, but not reported as lost."""
    channel = AggregatingPowers("ab", HT20_7)
    channel.rows[1][0] = 0.0
    rates: list[tuple[int, int]] = []
    attempt_numbers: list[int] = []

    class RecordedRate(FixedRate):
        @override
        def choose(self, now_ns: int, packet: PacketIdentity, attempt: int) -> WifiMode:
            attempt_numbers.append(attempt)
            return super().choose(now_ns, packet, attempt)

        @override
        def report(self, mode: WifiMode, *, acknowledged: int, frames: int = 1) -> None:
            rates.append((acknowledged, frames))

    channel.rate_control = lambda transmitter, receiver: RecordedRate(HT20_7)  # type: ignore[method-assign]
    wifi: Wifi[int] = Wifi(channel, 1)
    wifi.use_meter()
    losses: list[int] = []
    wifi.log_losses(lambda _, payload, *rest: losses.append(payload))
    starts_ns: set[int] = set()
    wifi.log_attempts(lambda attempt: starts_ns.add(attempt.start_ns) if attempt.number else None)
    for number in range(3):
        wifi.send(0, "a", number, 1028, "b")
    assert [payload for _, _, payload, _, _ in wifi.deliveries(10**10)] == [0, 1, 2]
    assert losses == []
    counters = wifi.counters()["a", "b"]
    assert (counters.sent, counters.lost, counters.delivered) == (3, 0, 3)
    exchanges = len(starts_ns)
    assert attempt_numbers == [min(number, SHORT_RETRY_LIMIT) for number in range(1, exchanges + 1)]
    assert all(acknowledged == 0 for acknowledged, _ in rates)
    assert sum(attempts for _, attempts in rates) == 3 * SHORT_RETRY_LIMIT
    (station,) = wifi.sample(10**10, 0)["a"].stations
    assert (station.tx_packets, station.tx_failures) == (3, 3)


def test_a_dropped_frame_does_not_block_the_frames_after_it() -> None:
    channel = AggregatingPowers("ab", HT20_7)
    wifi: Wifi[int] = Wifi(channel, 1)
    rows_in_range = channel.rows
    channel.rows = [[power * 1e-9 for power in row] for row in rows_in_range]
    wifi.send(0, "a", 0, 1028, "b")
    assert wifi.deliveries(10**9) == []
    channel.rows = rows_in_range
    wifi.send(10**9, "a", 1, 1028, "b")
    assert [payload for _, _, payload, _, _ in wifi.deliveries(2 * 10**9)] == [1]


def test_frames_of_a_station_that_is_switched_off_are_lost_once() -> None:
    wifi: Wifi[int] = Wifi(AggregatingPowers("ab", HT20_7), 1)
    losses: list[int] = []
    wifi.log_losses(lambda _, payload, *rest: losses.append(payload))
    for number in range(200):
        wifi.send(0, "a", number, 1028, "b")
    arrived_numbers = [payload for _, _, payload, _, _ in wifi.deliveries(3_000_000)]
    wifi.switch_off(3_000_000, {"a"})
    arrived_numbers += [payload for _, _, payload, _, _ in wifi.deliveries(10**10)]
    assert sorted(arrived_numbers + losses) == list(range(200))
    assert arrived_numbers == sorted(arrived_numbers)


def test_drivers_count_the_frames_of_aggregates() -> None:
    wifi: Wifi[int] = Wifi(AggregatingPowers("ab", VHT80_9), 1)
    wifi.use_meter()
    for number in range(100):
        wifi.send(0, "a", number, 1028, "b")
    wifi.deliveries(10**9)
    (station,) = wifi.sample(10**9, 0)["a"].stations
    assert (station.tx_packets, station.tx_retries, station.tx_failures) == (100, 0, 0)
    assert station.tx_rate_bit_s == pytest.approx(866.7e6, rel=1e-4)
