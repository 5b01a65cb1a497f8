"""RTS and CTS compared with closed forms and with ns-3; hidden stations, a missing CTS, and the threshold."""

from collections.abc import Sequence
from itertools import pairwise

import pytest
from typing_extensions import override

from sim_backends.radio.core.links import RETRIES_EXHAUSTED
from sim_backends.radio.mac.aggregation import AMPDU_LIMITS, AmpduLimits
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.phy.high_throughput import format_modes
from sim_backends.radio.phy.modes import (
    CW_MIN,
    G_MODES,
    SHORT_RETRY_LIMIT,
    SLOT_NS,
    WifiMode,
    control_mode,
    response_ns,
)
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import FixedPowers, saturate

HT20_7 = format_modes("HT", "2.4 GHz", 20, 1, 800)[7]
G54 = G_MODES[-1]
BAND = HT20_7.band
# 61 subframes of 4 + 1028 + 38 bytes and padding fit into 65,535 bytes, but only 41 into 5.484 ms.
FRAMES = 41


class ProtectingPowers(FixedPowers):
    """Stations with RTS; in modes of 802.11n they aggregate frames and have the inter-frame space of best effort."""

    def __init__(
        self,
        names: Sequence[str],
        mode: WifiMode,
        *,
        without_link: Sequence[tuple[str, str]] = (),
        threshold: int | None = 0,
    ) -> None:
        super().__init__(names, mode, without_link=without_link)
        self.mode = mode
        self.threshold = threshold

    @override
    def rts_threshold_bytes(self, station: int) -> int | None:
        return self.threshold

    @override
    def ifs_ns(self, station: int) -> int:
        return self.band.best_effort_aifs_ns if self.mode.is_high_throughput else self.band.difs_ns

    @override
    def ampdu_limits(self, transmitter: int, receiver: int) -> AmpduLimits | None:
        return AMPDU_LIMITS["HT"] if self.mode.is_high_throughput else None


def goodput(channel: ProtectingPowers, senders: Sequence[str], *, seconds: float, queued: int = 150) -> float:
    return sum(saturate(channel, senders, "r", seconds=seconds, queued=queued).values())


def exchange_ns(mode: WifiMode, size_bytes: int, answer_bytes: int) -> tuple[int, int]:
    """Return the time of RTS and of the whole exchange, which ends with the answer to the data."""
    control = control_mode(mode)
    rts_ns, cts_ns = control.airtime_ns(20), control.airtime_ns(14)
    data_ns = mode.airtime_ns(size_bytes) + BAND.sifs_ns + response_ns(mode, answer_bytes)
    return rts_ns, rts_ns + BAND.sifs_ns + cts_ns + BAND.sifs_ns + data_ns


def test_goodput_of_one_station_equals_the_closed_form() -> None:
    """Mean backoff of 7.5 slots, then RTS, CTS, data and its answer."""
    for mode, size_bytes, answer_bytes, frames in ((HT20_7, 1072 * FRAMES - 2, 32, FRAMES), (G54, 1064, 14, 1)):
        ifs_ns = BAND.best_effort_aifs_ns if mode.is_high_throughput else BAND.difs_ns
        _, busy_ns = exchange_ns(mode, size_bytes, answer_bytes)
        expected = frames * 8000 / (ifs_ns + CW_MIN / 2 * SLOT_NS + busy_ns) * 1e9
        assert goodput(ProtectingPowers("ar", mode), ["a"], seconds=1.0) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("stations", [2, 5, 10])
def test_contending_stations_follow_bianchi_with_rts(stations: int) -> None:
    """Bianchi, IEEE JSAC 18:535 (2000), eq. 7 to 13 and 17: a collision lasts for RTS and EIFS."""
    window, stages, low, high = CW_MIN + 1, 6, 0.0, 1.0
    for _ in range(60):
        tau = (low + high) / 2
        collision = 1 - (1 - tau) ** (stations - 1)
        doubling = sum((2 * collision) ** stage for stage in range(stages))
        high, low = (high, tau) if tau < 2 / (1 + window + collision * window * doubling) else (tau, low)
    rts_ns, busy_ns = exchange_ns(G54, 1064, 14)
    collision_ns = rts_ns + BAND.sifs_ns + G_MODES[0].airtime_ns(14) + BAND.difs_ns
    idle, single = (1 - tau) ** stations, stations * tau * (1 - tau) ** (stations - 1)
    slot_ns = idle * SLOT_NS + single * (busy_ns + BAND.difs_ns) + (1 - idle - single) * collision_ns
    names = [f"s{number}" for number in range(stations)]
    measured_bit_s = goodput(ProtectingPowers([*names, "r"], G54), names, seconds=1.5, queued=20)
    assert measured_bit_s == pytest.approx(single * 8000 / slot_ns * 1e9, rel=0.03)


# ns-3 3.37: `benchmarks.high_throughput_vs_ns3`, A-MPDU with RTS, payloads of 1000 bytes.
@pytest.mark.parametrize(("stations", "ns3_mbit_s"), [(1, 57.58), (5, 57.89), (10, 57.81)])
def test_goodput_of_aggregates_with_rts_is_within_two_percent_of_ns3(stations: int, ns3_mbit_s: float) -> None:
    names = [f"s{number}" for number in range(stations)]
    measured_bit_s = goodput(ProtectingPowers([*names, "r"], HT20_7), names, seconds=1.0)
    assert measured_bit_s / 1e6 == pytest.approx(ns3_mbit_s, rel=0.02)


def test_hidden_stations_collide_in_rts_and_not_in_data() -> None:
    log: list[TransmissionAttempt] = []
    rates = {}
    for threshold in (0, None):
        channel = ProtectingPowers("abr", HT20_7, without_link=[("a", "b")], threshold=threshold)
        log.clear()
        rates[threshold] = sum(saturate(channel, "ab", "r", seconds=1.0, queued=150, log=log).values())
        data = [attempt for attempt in log if attempt.number]
        share = sum(bool(attempt.received) for attempt in data) / len(data)
        assert share > 0.97 if threshold == 0 else share < 0.7
        # The CTS keeps the hidden station silent during the data, unless it has sent RTS at the time of the CTS.
        data_spans_ns = {(attempt.start_ns, attempt.end_ns) for attempt in data}
        starts = [attempt.start_ns for attempt in log if attempt.control == "RTS"]
        overlaps = sum(any(begin < start_ns < end for begin, end in data_spans_ns) for start_ns in starts)
        assert overlaps < 0.1 * len(starts) or threshold is None
    assert rates[0] > 1.2 * rates[None]


def test_a_station_that_has_received_a_cts_for_another_station_does_not_answer_an_rts() -> None:
    """Station r receives the CTS of y, but not the data from x to y; a receives neither."""
    wifi: Wifi[int] = Wifi(ProtectingPowers("arxy", G_MODES[0], without_link=[("a", "x"), ("a", "y"), ("r", "x")]), 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    wifi.send(0, "x", 0, 1500, "y")
    wifi.send(500_000, "a", 1, 1500, "r")
    assert len(wifi.deliveries(10**9)) == 2
    first_data = next(attempt for attempt in log if attempt.number)
    assert first_data.transmitter == "x"
    attempts_during_data = [attempt for attempt in log if first_data.start_ns < attempt.start_ns < first_data.end_ns]
    assert {(attempt.control, attempt.transmitter) for attempt in attempts_during_data} == {("RTS", "a")}


def test_frames_up_to_the_threshold_are_sent_without_rts() -> None:
    log: list[TransmissionAttempt] = []
    wifi: Wifi[str] = Wifi(ProtectingPowers("ar", G54, threshold=1064), 1)
    wifi.log_attempts(log.append)
    for size_bytes in (1028, 1029):
        wifi.send(0, "a", str(size_bytes), size_bytes, "r")
    wifi.deliveries(10**9)
    kinds = [(attempt.control or "data", attempt.size_bytes) for attempt in log]
    assert kinds == [("data", 1064), ("ACK", 14), ("RTS", 20), ("CTS", 14), ("data", 1065), ("ACK", 14)]
    assert all(later.start_ns - earlier.end_ns == BAND.sifs_ns for earlier, later in pairwise(log[2:]))


@pytest.mark.parametrize("mode", [G54, HT20_7], ids=lambda mode: mode.name)
def test_frames_without_cts_are_dropped_and_no_data_is_sent(mode: WifiMode) -> None:
    channel = ProtectingPowers("ar", mode, without_link=[("a", "r")])
    wifi: Wifi[int] = Wifi(channel, 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    wifi.use_meter()
    losses: list[tuple[int, str, str]] = []
    wifi.log_losses(lambda _, payload, station, reason: losses.append((payload, station, reason)))
    for number in range(2):
        wifi.send(0, "a", number, 1028, "r")
    assert wifi.deliveries(10**10) == []
    assert {attempt.control for attempt in log} == {"RTS"}
    assert losses == [(number, "r", RETRIES_EXHAUSTED) for number in range(2)]
    (station,) = wifi.sample(10**10, 0)["a"].stations
    assert (station.tx_packets, station.tx_retries, station.tx_failures) == (2, 2 * (SHORT_RETRY_LIMIT - 1), 2)


def test_after_rts_without_data_other_stations_wait_no_longer_than_for_the_cts() -> None:
    """The RTS does not arrive; b waits 2 SIFS, CTS, 20 us, 2 slots (10.3.2.4), DIFS and its backoff."""
    channel = ProtectingPowers("abr", G_MODES[0], without_link=[("a", "r")])
    wifi: Wifi[int] = Wifi(channel, 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    wifi.send(0, "a", 0, 1028, "r")
    wifi.send(1000, "b", 1, 1028, "r")
    wifi.deliveries(10**9)
    rts_attempts = [attempt for attempt in log if attempt.control == "RTS"]
    position = [attempt.transmitter for attempt in rts_attempts].index("b")
    first, second = rts_attempts[position - 1 : position + 1]
    assert first.transmitter == "a"
    cts_ns = G_MODES[0].airtime_ns(14)
    waits_ns = second.start_ns - first.end_ns - 2 * BAND.sifs_ns - cts_ns - 20_000 - 2 * SLOT_NS - BAND.difs_ns
    assert waits_ns % SLOT_NS == 0
    assert 0 <= waits_ns <= CW_MIN * SLOT_NS


def test_a_station_switched_off_between_rts_and_data_sends_nothing_more() -> None:
    wifi: Wifi[int] = Wifi(ProtectingPowers("ar", HT20_7), 1)
    log: list[TransmissionAttempt] = []
    wifi.log_attempts(log.append)
    wifi.send(0, "a", 0, 1028, "r")
    now_ns = 0
    while not any(attempt.control == "CTS" for attempt in log):
        now_ns += 1000
        wifi.deliveries(now_ns)
    wifi.switch_off(now_ns, {"a"})
    assert wifi.deliveries(now_ns + 10**9) == []
    assert [attempt.control for attempt in log] == ["RTS", "CTS"]
