"""DCF, compared with the closed form for one station and Bianchi's model for many; hidden stations."""

import math
from collections.abc import Sequence

import pytest
import scipy
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_backends.radio.core.links import (
    Delivery,
    delay_parts,
)
from sim_backends.radio.mac.contention import CCA_TIME_NS
from sim_backends.radio.mac.frames import HEADER_BYTES, TransmissionAttempt
from sim_backends.radio.phy.error_rates import packet_error
from sim_backends.radio.phy.modes import (
    CW_MIN,
    DIFS_NS,
    G_MODES,
    N_MODES,
    SHORT_RETRY_LIMIT,
    SIFS_NS,
    SLOT_NS,
    WifiMode,
    ack_ns,
)
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import HEADERS_BYTES, NOISE_MW, STRONG_MW, FixedPowers, saturate

G54, G6 = G_MODES[-1], G_MODES[0]
PAYLOAD_BYTES = 1000
PACKET_BYTES = PAYLOAD_BYTES + HEADERS_BYTES

# About 24 dB under the signal: a third of the frames in g54 fails.
WEAK_NOISE_MW = STRONG_MW / 10**2.22


def exchange_ns(mode: WifiMode) -> int:
    return mode.airtime_ns(PACKET_BYTES + HEADER_BYTES) + SIFS_NS + ack_ns(mode) + DIFS_NS


@pytest.mark.parametrize("mode", [G6, G54, N_MODES[-1]], ids=lambda mode: mode.name)
def test_the_goodput_of_one_station_equals_the_closed_form(mode: WifiMode) -> None:
    """DIFS, mean backoff of CWmin / 2 slots, frame, SIFS, ACK, and no collision."""
    goodput = saturate(FixedPowers("ab", mode), "a", "b", seconds=3)["a"]
    expected = 8 * PAYLOAD_BYTES / ((exchange_ns(mode) + CW_MIN / 2 * SLOT_NS) * 1e-9)
    assert goodput == pytest.approx(expected, rel=0.01)


def bianchi_bit_s(stations: int, mode: WifiMode) -> float:
    """Bianchi, IEEE J. Sel. Areas Commun. 18:535 (2000), eqs. 7 to 13, with ACK; 6 doublings of the window."""
    doublings, window = 6, CW_MIN + 1

    def tau(p: float) -> float:
        return 2 * (1 - 2 * p) / ((1 - 2 * p) * (window + 1) + p * window * (1 - (2 * p) ** doublings))

    p = scipy.optimize.brentq(lambda p: p - (1 - (1 - tau(p)) ** (stations - 1)), 0, 0.49)
    sending_probability = tau(p)
    any_sends = 1 - (1 - sending_probability) ** stations
    only_one_sends = stations * sending_probability * (1 - sending_probability) ** (stations - 1) / any_sends
    success_ns = collision_ns = exchange_ns(mode)
    slot_ns = (
        (1 - any_sends) * SLOT_NS
        + any_sends * only_one_sends * success_ns
        + any_sends * (1 - only_one_sends) * collision_ns
    )
    return any_sends * only_one_sends * 8 * PAYLOAD_BYTES / (slot_ns * 1e-9)


@pytest.mark.parametrize("stations", [2, 5, 10, 20])
def test_the_goodput_of_many_stations_equals_that_of_bianchis_model(stations: int) -> None:
    names = [f"s{n}" for n in range(stations)]
    goodput = saturate(FixedPowers([*names, "r"], G54), names, "r", seconds=4)
    total = sum(goodput.values())
    assert total == pytest.approx(bianchi_bit_s(stations, G54), rel=0.06)
    fairness = total**2 / (stations * sum(share**2 for share in goodput.values()))
    assert fairness > 0.96, "Jain's index: shares spread by 13 % over 4 s with 20 stations"
    assert min(goodput.values()) > total / stations / 2, "no station is starved"


def test_hidden_stations_collide_more_than_visible_ones() -> None:
    visible_goodput = saturate(FixedPowers("abr", G6), "ab", "r", seconds=4)
    hidden_goodput = saturate(FixedPowers("abr", G6, without_link=[("a", "b")]), "ab", "r", seconds=4)
    assert sum(hidden_goodput.values()) < 0.75 * sum(visible_goodput.values())


def test_an_access_point_needs_twice_the_airtime() -> None:
    direct_goodput = saturate(FixedPowers("abr", G54), "a", "b", seconds=2)["a"]
    relayed_goodput = saturate(FixedPowers("abr", G54), "a", "b", seconds=2, relay="r")["a"]
    # The access point competes with the station for each second hop, so a little is lost to collisions.
    assert relayed_goodput == pytest.approx(direct_goodput / 2, rel=0.06)


def test_an_ack_follows_each_received_frame_after_sifs() -> None:
    log: list[TransmissionAttempt] = []
    saturate(FixedPowers("abr", G54, without_link=[("a", "b")]), "ab", "r", seconds=0.2, log=log)
    acks = [attempt for attempt in log if not attempt.number]
    received_frames = {
        (attempt.end_ns, attempt.receiver, attempt.transmitter)
        for attempt in log
        if attempt.number and attempt.received
    }
    assert {(ack.start_ns - SIFS_NS, ack.transmitter, ack.receiver) for ack in acks} <= received_frames
    # A station that is sending at that time sends no ACK; the last ACK may not have been sent yet.
    assert 0.9 * len(received_frames) < len(acks) <= len(received_frames)
    assert {(ack.end_ns - ack.start_ns, ack.mode.name, ack.payload) for ack in acks} == {(ack_ns(G54), "g24", None)}


def test_a_broadcast_is_sent_once_at_the_basic_rate_without_ack() -> None:
    log: list[TransmissionAttempt] = []
    wifi: Wifi[bytes] = Wifi(FixedPowers("abc", G54), 1)
    wifi.log_attempts(log.append)
    wifi.send(0, "a", b"hello", 100, None)
    assert sorted(name for _, name, _, _, _ in wifi.deliveries(10**9)) == ["b", "c"]
    (attempt,) = log
    assert (attempt.mode, attempt.receiver, attempt.received) == (G6, None, ("b", "c"))
    assert wifi.next_event_ns() is None


def test_a_broadcast_through_an_access_point_reaches_each_station_once() -> None:
    wifi: Wifi[bytes] = Wifi(FixedPowers("abr", G54), 1)
    wifi.set_relay("r")
    wifi.send(0, "a", b"hello", 100, None)
    assert sorted(name for _, name, _, _, _ in wifi.deliveries(10**9)) == ["b", "r"]


def test_an_unreachable_receiver_causes_all_retries() -> None:
    log: list[TransmissionAttempt] = []
    wifi: Wifi[bytes] = Wifi(FixedPowers("ab", G54, without_link=[("a", "b")]), 1)
    wifi.log_attempts(log.append)
    wifi.send(0, "a", b"x", 100, "b")
    assert wifi.deliveries(10**9) == []
    assert [attempt.number for attempt in log] == list(range(1, SHORT_RETRY_LIMIT + 1))
    assert wifi.counters()["a", "b"].lost == 1


def test_a_full_queue_drops_the_newest_packets() -> None:
    wifi: Wifi[int] = Wifi(FixedPowers("ab", G54), 1, queue_packets=10)
    for number in range(20):
        wifi.send(0, "a", number, 100, "b")
    assert [payload for _, _, payload, _, _ in wifi.deliveries(10**9)] == list(range(11)), (
        "one on the air, ten waiting"
    )
    assert wifi.counters()["a", "b"].queue_dropped == 9


def test_interference_that_starts_late_corrupts_a_frame() -> None:
    """The stations are hidden from each other; the second starts during the frame of the first, and is as strong."""
    log: list[TransmissionAttempt] = []
    wifi: Wifi[str] = Wifi(FixedPowers("abr", G6, without_link=[("a", "b")]), 1)
    wifi.log_attempts(log.append)
    wifi.send(0, "a", "first", 1000, "r")
    wifi.send(500_000, "b", "second", 1000, "r")
    wifi.deliveries(3_000_000)
    assert [(attempt.transmitter, attempt.received) for attempt in log[:2]] == [("a", ()), ("b", ())]


def test_a_strong_frame_survives_weak_interference() -> None:
    channel = FixedPowers("abr", G6, without_link=[("a", "b")])
    channel.rows[1][2] = STRONG_MW / 1000
    wifi: Wifi[str] = Wifi(channel, 1)
    wifi.send(0, "a", "first", 1000, "r")
    wifi.send(500_000, "b", "second", 1000, "r")
    assert wifi.deliveries(3_000_000)[0][2] == "first"


def test_the_loss_of_a_weak_link_equals_its_packet_error() -> None:
    """Packets are broadcast, so that no retry hides a loss."""
    channel, ratio_db, size_bytes, frames = FixedPowers("ab", G6), 4.05, 1500, 4000
    channel.rows[0][1] = NOISE_MW * 10 ** (ratio_db / 10)
    channel.sensitivity_mw = [NOISE_MW] * 2
    wifi: Wifi[int] = Wifi(channel, 1, queue_packets=frames)
    for number in range(frames):
        wifi.send(0, "a", number, size_bytes, None)
    loss = 1 - len(wifi.deliveries(60 * 10**9)) / frames
    expected = packet_error(G6, ratio_db, size_bytes + HEADER_BYTES)
    assert 0.02 < expected < 0.5
    assert loss == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / frames))


def test_below_4_db_the_preamble_is_not_detected() -> None:
    channel = FixedPowers("ab", G6)
    channel.rows[0][1] = NOISE_MW * 10 ** (3.9 / 10)
    channel.sensitivity_mw = [NOISE_MW] * 2
    wifi: Wifi[int] = Wifi(channel, 1)
    wifi.send(0, "a", 1, 10, None)
    assert wifi.deliveries(10**9) == []


@settings(max_examples=25)
@given(st.integers(0, 2**32), st.lists(st.tuples(st.integers(0, 20_000_000), st.integers(40, 1500)), max_size=40))
def test_equal_seeds_give_equal_results_in_order_of_time(seed: int, sent_frames: list[tuple[int, int]]) -> None:
    def run() -> tuple[list[Delivery[int]], list[TransmissionAttempt]]:
        log: list[TransmissionAttempt] = []
        wifi: Wifi[int] = Wifi(FixedPowers("abr", G54, without_link=[("a", "b")]), seed)
        wifi.log_attempts(log.append)
        for number, (at_ns, size) in enumerate(sorted(sent_frames)):
            wifi.send(at_ns, "ab"[number % 2], number, size, "r")
        return wifi.deliveries(60 * 10**9), log

    deliveries, log = run()
    assert run() == (deliveries, log)
    assert [delivery[0] for delivery in deliveries] == sorted(delivery[0] for delivery in deliveries)
    assert len({delivery[2] for delivery in deliveries}) == len(deliveries), (
        "a retry after a lost ACK is delivered once"
    )
    for sender in "ab":
        from_sender = [delivery[2] for delivery in deliveries if "ab"[delivery[2] % 2] == sender]
        assert from_sender == sorted(from_sender), "frames of one station arrive in order"
    assert all(math.isfinite(attempt.end_ns) and attempt.end_ns > attempt.start_ns for attempt in log)


def test_deliveries_do_not_depend_on_the_times_of_calls() -> None:
    def run(step_ns: int) -> list[Delivery[int]]:
        wifi: Wifi[int] = Wifi(FixedPowers("abr", G54), 3)
        for number in range(50):
            wifi.send(0, "ab"[number % 2], number, 700, "r")
        deliveries: list[Delivery[int]] = []
        for now_ns in range(0, 40_000_001, step_ns):
            deliveries += wifi.deliveries(now_ns)
        return deliveries

    assert run(40_000_000) == run(1_000_000) == run(8_000)


def test_the_number_of_events_per_frame_is_bounded() -> None:
    """Stations that wait longer because others send cause no events, so that the medium is not resumed needlessly."""
    log: list[TransmissionAttempt] = []
    wifi: Wifi[int] = Wifi(FixedPowers([*"abcdefghijklmnopqrst"], G54), 1)
    wifi.log_attempts(log.append)
    for number in range(400):
        wifi.send(0, "abcdefghijklmnopqrs"[number % 19], number, 700, "t")
    steps = 0
    while (now_ns := wifi.next_event_ns()) is not None:
        wifi.deliveries(now_ns)
        steps += 1
    data_attempts = sum(attempt.number > 0 for attempt in log)
    assert data_attempts >= 400
    # Start and end of the frame, start and end of its ACK, and the timeout that the ACK made void.
    assert steps <= 5 * data_attempts


def test_received_powers_follow_changes_of_the_channel() -> None:
    channel = FixedPowers("ab", G6)
    wifi: Wifi[str] = Wifi(channel, 1)
    wifi.send(0, "a", "near", 100, None)
    assert len(wifi.deliveries(10**9)) == 1
    row_in_range, channel.rows[0] = channel.rows[0], [0.0, 0.0]
    wifi.send(10**9, "a", "far", 100, None)
    assert wifi.deliveries(2 * 10**9) == []
    channel.rows[0] = row_in_range
    wifi.send(2 * 10**9, "a", "near again", 100, None)
    assert [payload for _, _, payload, _, _ in wifi.deliveries(3 * 10**9)] == ["near again"]


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.sets(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=6))
def test_no_station_starts_while_it_detects_a_frame(seed: int, pairs_without_link: set[tuple[int, int]]) -> None:
    """Of two overlapping frames of stations that are not hidden from each other, the second starts within 4 us."""
    names = "abcde"
    pairs = [(names[first], names[second]) for first, second in pairs_without_link if first != second]
    log: list[TransmissionAttempt] = []
    saturate(FixedPowers(names, G54, without_link=pairs), "abcd", "e", seconds=0.1, seed=seed, log=log)
    hidden_pairs = {*pairs, *((second, first) for first, second in pairs)}
    data_attempts = [attempt for attempt in log if attempt.number]
    frames = sorted(data_attempts, key=lambda attempt: attempt.start_ns)
    for number, first in enumerate(frames):
        for second in frames[number + 1 :]:
            if second.start_ns >= first.end_ns:
                break
            if (first.transmitter, second.transmitter) not in hidden_pairs:
                assert second.start_ns - first.start_ns <= CCA_TIME_NS


@pytest.mark.parametrize("relay", [None, "r"])
def test_the_parts_of_the_delay_add_up_to_the_elapsed_time(relay: str | None) -> None:
    wifi: Wifi[int] = Wifi(FixedPowers("abr", G54), 1)
    wifi.set_relay(relay)
    for number in range(100):
        wifi.send(number * 1000, "a", number * 1000, 1000, "b")
    deliveries = wifi.deliveries(10**9)
    assert len(deliveries) == 100
    for at_ns, _, sent_ns, source, delay_sum in deliveries:
        parts = delay_parts(delay_sum)
        assert source == "a"
        assert parts.packets == 1
        total_ns = parts.queuing_ns + parts.transmission_ns + parts.propagation_ns + parts.processing_ns
        assert total_ns == at_ns - sent_ns
        assert parts.transmission_ns >= (2 if relay else 1) * G54.airtime_ns(1000 + HEADER_BYTES)


def test_frames_to_a_station_out_of_range_are_lost_immediately() -> None:
    class UnlinkedPowers(FixedPowers):
        def are_linked(self, transmitter: int, receiver: int) -> bool:
            return False

    wifi: Wifi[int] = Wifi(UnlinkedPowers("ab", G54), 1)
    wifi.send(0, "a", 1, 100, "b")
    assert wifi.next_event_ns() is None
    assert wifi.counters()["a", "b"].lost == 1


@given(st.sets(st.integers(0, 59)), st.booleans())
@settings(max_examples=30)
def test_a_missing_packet_does_not_change_the_others(missing_numbers: set[int], is_relayed: bool) -> None:
    """Every draw is keyed by the packet and the attempt, also with packets of other flows."""

    def attempts(numbers: Sequence[int]) -> dict[int, list[tuple[int, str, bool]]]:
        channel = FixedPowers("abr", G54)
        channel.noise_mw = [WEAK_NOISE_MW] * 3
        log: list[TransmissionAttempt] = []
        wifi: Wifi[int] = Wifi(channel, 1)
        wifi.log_attempts(log.append)
        wifi.set_relay("r" if is_relayed else None)
        for number in numbers:
            wifi.send(number * 100_000_000, "a", number, 1000, "b", packet=(f"flow {number % 3}", number // 3))
        wifi.deliveries(10**12)
        attempts_by_packet: dict[int, list[tuple[int, str, bool]]] = {}
        for attempt in log:
            if attempt.payload is not None:
                since_ns = attempt.start_ns - attempt.payload * 100_000_000
                attempts_by_packet.setdefault(attempt.payload, []).append(
                    (since_ns, attempt.transmitter, bool(attempt.received))
                )
        return attempts_by_packet

    all_attempts = attempts(range(60))
    assert max(map(len, all_attempts.values())) > 2, "there are retries"
    assert attempts([number for number in range(60) if number not in missing_numbers]) == {
        number: packet_attempts for number, packet_attempts in all_attempts.items() if number not in missing_numbers
    }
