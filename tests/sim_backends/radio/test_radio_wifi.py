"""DCF: against the closed form of one station, Bianchi's model of many, and what must happen to hidden ones."""

import math
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from sim_backends.radio import delay
from sim_backends.radio.contention import BLIND_NS
from sim_backends.radio.delay import Delivery
from sim_backends.radio.frames import HEADER_BYTES, TransmissionAttempt
from sim_backends.radio.modes import (
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
from sim_backends.radio.packet_error import packet_error
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
def test_one_station_gets_what_the_closed_form_says(mode: WifiMode) -> None:
    """DIFS, mean backoff of CWmin / 2 slots, frame, SIFS, ACK, and no collision."""
    goodput = saturate(FixedPowers("ab", mode), "a", "b", seconds=3)["a"]
    expected = 8 * PAYLOAD_BYTES / ((exchange_ns(mode) + CW_MIN / 2 * SLOT_NS) * 1e-9)
    assert goodput == pytest.approx(expected, rel=0.01)


def bianchi_bit_s(stations: int, mode: WifiMode) -> float:
    """Bianchi, IEEE J. Sel. Areas Commun. 18:535 (2000), eqs. 7 to 13, with ACK; 6 doublings of the window."""
    doublings, window = 6, CW_MIN + 1

    def tau(p: float) -> float:
        return 2 * (1 - 2 * p) / ((1 - 2 * p) * (window + 1) + p * window * (1 - (2 * p) ** doublings))

    p = brentq(lambda p: p - (1 - (1 - tau(p)) ** (stations - 1)), 0, 0.49)
    sends = tau(p)
    some = 1 - (1 - sends) ** stations
    one = stations * sends * (1 - sends) ** (stations - 1) / some
    success_ns = collision_ns = exchange_ns(mode)
    slot_ns = (1 - some) * SLOT_NS + some * one * success_ns + some * (1 - one) * collision_ns
    return some * one * 8 * PAYLOAD_BYTES / (slot_ns * 1e-9)


@pytest.mark.parametrize("stations", [2, 5, 10, 20])
def test_many_stations_share_as_bianchi_says(stations: int) -> None:
    names = [f"s{n}" for n in range(stations)]
    goodput = saturate(FixedPowers([*names, "r"], G54), names, "r", seconds=4)
    total = sum(goodput.values())
    assert total == pytest.approx(bianchi_bit_s(stations, G54), rel=0.06)
    fairness = total**2 / (stations * sum(one**2 for one in goodput.values()))
    assert fairness > 0.96, "Jain's index: shares spread by 13 % over 4 s with 20 stations"
    assert min(goodput.values()) > total / stations / 2, "no station is starved"


def test_hidden_stations_collide_and_those_that_hear_each_other_do_not() -> None:
    seen = saturate(FixedPowers("abr", G6), "ab", "r", seconds=4)
    hidden = saturate(FixedPowers("abr", G6, deaf=[("a", "b")]), "ab", "r", seconds=4)
    assert sum(hidden.values()) < 0.75 * sum(seen.values())


def test_an_access_point_spends_the_airtime_twice() -> None:
    direct = saturate(FixedPowers("abr", G54), "a", "b", seconds=2)["a"]
    relayed = saturate(FixedPowers("abr", G54), "a", "b", seconds=2, relay="r")["a"]
    # The access point competes with the station for each second hop, so a little is lost to collisions.
    assert relayed == pytest.approx(direct / 2, rel=0.06)


def test_an_ack_follows_each_frame_that_arrived_after_sifs() -> None:
    log: list[TransmissionAttempt] = []
    saturate(FixedPowers("abr", G54, deaf=[("a", "b")]), "ab", "r", seconds=0.2, log=log)
    acks = [attempt for attempt in log if not attempt.number]
    arrived = {(one.end_ns, one.receiver, one.transmitter) for one in log if one.number and one.received}
    assert {(ack.start_ns - SIFS_NS, ack.transmitter, ack.receiver) for ack in acks} <= arrived
    # Whoever sends itself by then answers none; the last of all may be still to come.
    assert 0.9 * len(arrived) < len(acks) <= len(arrived)
    assert {(ack.end_ns - ack.start_ns, ack.mode.name, ack.payload) for ack in acks} == {(ack_ns(G54), "g24", None)}


def test_a_broadcast_goes_out_once_at_the_basic_rate_and_nobody_acknowledges() -> None:
    log: list[TransmissionAttempt] = []
    wifi: Wifi[bytes] = Wifi(FixedPowers("abc", G54), 1)
    wifi.log_attempts(log.append)
    wifi.send(0, "a", b"hello", 100, None)
    assert sorted(name for _, name, _, _, _ in wifi.deliveries(10**9)) == ["b", "c"]
    (attempt,) = log
    assert (attempt.mode, attempt.receiver, attempt.received) == (G6, None, ("b", "c"))
    assert wifi.next_event_ns() is None


def test_a_broadcast_through_an_access_point_reaches_everyone_once() -> None:
    wifi: Wifi[bytes] = Wifi(FixedPowers("abr", G54), 1)
    wifi.relay("r")
    wifi.send(0, "a", b"hello", 100, None)
    assert sorted(name for _, name, _, _, _ in wifi.deliveries(10**9)) == ["b", "r"]


def test_a_receiver_that_is_gone_costs_every_retry() -> None:
    log: list[TransmissionAttempt] = []
    wifi: Wifi[bytes] = Wifi(FixedPowers("ab", G54, deaf=[("a", "b")]), 1)
    wifi.log_attempts(log.append)
    wifi.send(0, "a", b"x", 100, "b")
    assert wifi.deliveries(10**9) == []
    assert [attempt.number for attempt in log] == list(range(1, SHORT_RETRY_LIMIT + 1))
    assert wifi.counters()["a", "b"].lost == 1


def test_a_full_queue_drops_what_comes_last() -> None:
    wifi: Wifi[int] = Wifi(FixedPowers("ab", G54), 1, queue_packets=10)
    for number in range(20):
        wifi.send(0, "a", number, 100, "b")
    assert [payload for _, _, payload, _, _ in wifi.deliveries(10**9)] == list(range(11)), (
        "one on the air, ten waiting"
    )
    assert wifi.counters()["a", "b"].queue_dropped == 9


def test_interference_that_begins_late_spoils_a_frame() -> None:
    """Hidden from each other, the second begins in the midst of the first; at the receiver it is as strong."""
    log: list[TransmissionAttempt] = []
    wifi: Wifi[str] = Wifi(FixedPowers("abr", G6, deaf=[("a", "b")]), 1)
    wifi.log_attempts(log.append)
    wifi.send(0, "a", "first", 1000, "r")
    wifi.send(500_000, "b", "second", 1000, "r")
    wifi.deliveries(3_000_000)
    assert [(attempt.transmitter, attempt.received) for attempt in log[:2]] == [("a", ()), ("b", ())]


def test_a_strong_frame_survives_weak_interference() -> None:
    channel = FixedPowers("abr", G6, deaf=[("a", "b")])
    channel.rows[1][2] = STRONG_MW / 1000
    wifi: Wifi[str] = Wifi(channel, 1)
    wifi.send(0, "a", "first", 1000, "r")
    wifi.send(500_000, "b", "second", 1000, "r")
    assert wifi.deliveries(3_000_000)[0][2] == "first"


def test_a_weak_link_loses_what_its_packet_error_says() -> None:
    """Broadcasts, so that no retry hides a loss."""
    channel, ratio_db, size_bytes, frames = FixedPowers("ab", G6), 4.05, 1500, 4000
    channel.rows[0][1] = NOISE_MW * 10 ** (ratio_db / 10)
    channel.sensitivity_mw = [NOISE_MW] * 2
    wifi: Wifi[int] = Wifi(channel, 1, queue_packets=frames)
    for number in range(frames):
        wifi.send(0, "a", number, size_bytes, None)
    lost = 1 - len(wifi.deliveries(60 * 10**9)) / frames
    expected = packet_error(G6, ratio_db, size_bytes + HEADER_BYTES)
    assert 0.02 < expected < 0.5
    assert lost == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / frames))


def test_below_four_decibels_not_even_a_preamble_is_found() -> None:
    channel = FixedPowers("ab", G6)
    channel.rows[0][1] = NOISE_MW * 10 ** (3.9 / 10)
    channel.sensitivity_mw = [NOISE_MW] * 2
    wifi: Wifi[int] = Wifi(channel, 1)
    wifi.send(0, "a", 1, 10, None)
    assert wifi.deliveries(10**9) == []


@settings(max_examples=25)
@given(st.integers(0, 2**32), st.lists(st.tuples(st.integers(0, 20_000_000), st.integers(40, 1500)), max_size=40))
def test_equal_seeds_give_equal_fates_and_time_never_runs_back(seed: int, sends: list[tuple[int, int]]) -> None:
    def run() -> tuple[list[Delivery[int]], list[TransmissionAttempt]]:
        log: list[TransmissionAttempt] = []
        wifi: Wifi[int] = Wifi(FixedPowers("abr", G54, deaf=[("a", "b")]), seed)
        wifi.log_attempts(log.append)
        for number, (at_ns, size) in enumerate(sorted(sends)):
            wifi.send(at_ns, "ab"[number % 2], number, size, "r")
        return wifi.deliveries(60 * 10**9), log

    arrived, log = run()
    assert run() == (arrived, log)
    assert [one[0] for one in arrived] == sorted(one[0] for one in arrived)
    assert len({one[2] for one in arrived}) == len(arrived), "a retry whose ACK was lost comes once"
    for sender in "ab":
        own = [one[2] for one in arrived if "ab"[one[2] % 2] == sender]
        assert own == sorted(own), "frames of one station arrive in order"
    assert all(math.isfinite(attempt.end_ns) and attempt.end_ns > attempt.start_ns for attempt in log)


def test_deliveries_do_not_depend_on_when_they_are_asked_for() -> None:
    def run(step_ns: int) -> list[Delivery[int]]:
        wifi: Wifi[int] = Wifi(FixedPowers("abr", G54), 3)
        for number in range(50):
            wifi.send(0, "ab"[number % 2], number, 700, "r")
        found: list[Delivery[int]] = []
        for now_ns in range(0, 40_000_001, step_ns):
            found += wifi.deliveries(now_ns)
        return found

    assert run(40_000_000) == run(1_000_000) == run(8_000)


def test_the_engine_asks_for_attention_only_when_something_happens() -> None:
    """Stations that wait longer because others send cost no event each: the medium would be woken for nothing."""
    log: list[TransmissionAttempt] = []
    wifi: Wifi[int] = Wifi(FixedPowers([*"abcdefghijklmnopqrst"], G54), 1)
    wifi.log_attempts(log.append)
    for number in range(400):
        wifi.send(0, "abcdefghijklmnopqrs"[number % 19], number, 700, "t")
    steps = 0
    while (now_ns := wifi.next_event_ns()) is not None:
        wifi.deliveries(now_ns)
        steps += 1
    sent = sum(attempt.number > 0 for attempt in log)
    assert sent >= 400
    # Begin, end, its ACK's begin and end, and the time-out that the ACK made void.
    assert steps <= 5 * sent


def test_a_channel_that_changes_is_heard_as_it_is_then() -> None:
    channel = FixedPowers("ab", G6)
    wifi: Wifi[str] = Wifi(channel, 1)
    wifi.send(0, "a", "near", 100, None)
    assert len(wifi.deliveries(10**9)) == 1
    near, channel.rows[0] = channel.rows[0], [0.0, 0.0]
    wifi.send(10**9, "a", "far", 100, None)
    assert wifi.deliveries(2 * 10**9) == []
    channel.rows[0] = near
    wifi.send(2 * 10**9, "a", "near again", 100, None)
    assert [payload for _, _, payload, _, _ in wifi.deliveries(3 * 10**9)] == ["near again"]


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.sets(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=6))
def test_nobody_begins_while_it_hears_another(seed: int, deaf: set[tuple[int, int]]) -> None:
    """Whoever is hidden from whom: of two frames that overlap and hear each other, both began within 4 us."""
    names = "abcde"
    pairs = [(names[one], names[other]) for one, other in deaf if one != other]
    log: list[TransmissionAttempt] = []
    saturate(FixedPowers(names, G54, deaf=pairs), "abcd", "e", seconds=0.1, seed=seed, log=log)
    hidden = {*pairs, *((other, one) for one, other in pairs)}
    sent = [attempt for attempt in log if attempt.number]
    begun = sorted(sent, key=lambda attempt: attempt.start_ns)
    for number, first in enumerate(begun):
        for second in begun[number + 1 :]:
            if second.start_ns >= first.end_ns:
                break
            if (first.transmitter, second.transmitter) not in hidden:
                assert second.start_ns - first.start_ns <= BLIND_NS


@pytest.mark.parametrize("relay", [None, "r"])
def test_the_parts_of_the_delay_sum_up_to_the_time_that_passed(relay: str | None) -> None:
    wifi: Wifi[int] = Wifi(FixedPowers("abr", G54), 1)
    wifi.relay(relay)
    for number in range(100):
        wifi.send(number * 1000, "a", number * 1000, 1000, "b")
    arrived = wifi.deliveries(10**9)
    assert len(arrived) == 100
    for at_ns, _, sent_ns, source, delayed in arrived:
        parts = delay.parts(delayed)
        assert source == "a"
        assert parts.packets == 1
        took_ns = parts.queuing_ns + parts.transmission_ns + parts.propagation_ns + parts.processing_ns
        assert took_ns == at_ns - sent_ns
        assert parts.transmission_ns >= (2 if relay else 1) * G54.airtime_ns(1000 + HEADER_BYTES)


def test_frames_to_who_is_out_of_range_are_lost_at_once() -> None:
    class Apart(FixedPowers):
        def linked(self, transmitter: int, receiver: int) -> bool:
            return False

    wifi: Wifi[int] = Wifi(Apart("ab", G54), 1)
    wifi.send(0, "a", 1, 100, "b")
    assert wifi.next_event_ns() is None
    assert wifi.counters()["a", "b"].lost == 1


@given(st.sets(st.integers(0, 59)), st.booleans())
@settings(max_examples=30)
def test_one_packet_less_changes_nothing_for_the_others(missing: set[int], relayed: bool) -> None:
    """Every draw is keyed by the packet and the attempt at it, also where there are others of other flows."""

    def attempts(numbers: Sequence[int]) -> dict[int, list[tuple[int, str, bool]]]:
        channel = FixedPowers("abr", G54)
        channel.noise_mw = [WEAK_NOISE_MW] * 3
        log: list[TransmissionAttempt] = []
        wifi: Wifi[int] = Wifi(channel, 1)
        wifi.log_attempts(log.append)
        wifi.relay("r" if relayed else None)
        for number in numbers:
            wifi.send(number * 100_000_000, "a", number, 1000, "b", packet=(f"flow {number % 3}", number // 3))
        wifi.deliveries(10**12)
        made: dict[int, list[tuple[int, str, bool]]] = {}
        for one in log:
            if one.payload is not None:
                since_ns = one.start_ns - one.payload * 100_000_000
                made.setdefault(one.payload, []).append((since_ns, one.transmitter, bool(one.received)))
        return made

    whole = attempts(range(60))
    assert max(map(len, whole.values())) > 2, "some are tried again"
    assert attempts([number for number in range(60) if number not in missing]) == {
        number: one for number, one in whole.items() if number not in missing
    }
