"""Driver counters, compared with the log of all attempts."""

from collections import defaultdict
from collections.abc import Iterable
from itertools import pairwise

import pytest

from fieldkit.core.model import StationSample
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.phy.modes import G_MODES, SHORT_RETRY_LIMIT
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import NOISE_MW, STRONG_MW, FixedPowers

G54 = G_MODES[-1]
END_NS = 300_000_000


class TrafficRun:
    """A run in which stations a and b always have packets for r, which replies to every fourth packet."""

    def __init__(self, channel: FixedPowers, *, metered: bool = True, samples_ns: Iterable[int] = ()) -> None:
        self.log: list[TransmissionAttempt] = []
        self.wifi: Wifi[str] = Wifi(channel, 1)
        if metered:
            self.wifi.use_meter()
        self.wifi.log_attempts(self.log.append)
        self.delivered: defaultdict[tuple[str, str], int] = defaultdict(int)
        for name in "ab":
            for _ in range(20):
                self.wifi.send(0, name, name, 1000, "r")
        due_times_ns = [*samples_ns]
        while (now_ns := self.wifi.next_event_ns()) is not None and now_ns < END_NS:
            for at_ns, receiver, source, _, _ in self.wifi.deliveries(now_ns):
                self.delivered[source, receiver] += 1
                if receiver == "r":
                    self.wifi.send(at_ns, source, source, 1000, "r")
                    if self.delivered[source, receiver] % 4 == 0:
                        self.wifi.send(at_ns, "r", "r", 200, source)
            while due_times_ns and due_times_ns[0] <= now_ns:
                due_times_ns.pop(0)
                self.wifi.sample(now_ns, now_ns)

    def station_sample(self, name: str, peer: str) -> StationSample:
        stations = self.wifi.sample(END_NS, END_NS)[name].stations
        return next(station for station in stations if station.station == peer)


@pytest.fixture(params=["clear", "noisy", "hidden"])
def channel(request: pytest.FixtureRequest) -> FixedPowers:
    fixed_powers = FixedPowers("abr", G54, without_link=[("a", "b")] if request.param == "hidden" else [])
    if request.param == "noisy":
        fixed_powers.noise_mw = [STRONG_MW / 10**2.22] * 3
    return fixed_powers


def test_counters_equal_the_attempts_in_the_log(channel: FixedPowers) -> None:
    traffic = TrafficRun(channel)
    for name, peer in (("a", "r"), ("r", "b")):
        station_sample = traffic.station_sample(name, peer)
        # A frame that has not ended is not in the log yet: one at most.
        numbers = [
            attempt.number
            for attempt in traffic.log
            if (attempt.transmitter, attempt.receiver) == (name, peer) and attempt.number
        ]
        assert station_sample.tx_packets is not None
        assert station_sample.tx_retries is not None
        assert 0 <= station_sample.tx_packets - numbers.count(1) <= 1
        assert 0 <= station_sample.tx_packets + station_sample.tx_retries - len(numbers) <= 1
        assert station_sample.tx_rate_bit_s == G54.rate_bit_s
        assert station_sample.signal_dbm == pytest.approx(-40.0)
        assert 0 <= traffic.delivered[name, peer] - (traffic.station_sample(peer, name).rx_packets or 0) <= 1
    assert traffic.station_sample("r", "b").rx_rate_bit_s == G54.rate_bit_s


def test_a_failure_is_a_last_attempt_without_an_ack(channel: FixedPowers) -> None:
    traffic = TrafficRun(channel)
    exchange_frames = [attempt for attempt in traffic.log if attempt.number == 0 or attempt.transmitter == "a"]
    final_failures = [
        not (after.number == 0 and after.receiver == "a" and after.received)
        for attempt, after in pairwise(exchange_frames)
        if attempt.transmitter == "a" and attempt.number == SHORT_RETRY_LIMIT
    ]
    assert traffic.station_sample("a", "r").tx_failures == pytest.approx(sum(final_failures), abs=1)


def test_the_channel_is_busy_while_a_station_sends_or_detects_a_frame(channel: FixedPowers) -> None:
    traffic = TrafficRun(channel)
    without_link = {("a", "b"), ("b", "a")} if channel.rows[0][1] == 0 else set()
    for name in "abr":
        detected_attempts = [attempt for attempt in traffic.log if (name, attempt.transmitter) not in without_link]
        edges = sorted({edge for attempt in detected_attempts for edge in (attempt.start_ns, attempt.end_ns)})
        busy_ns = sum(
            stop - start
            for start, stop in pairwise(edges)
            if any(attempt.start_ns <= start and attempt.end_ns >= stop for attempt in detected_attempts)
        )
        sample = traffic.wifi.sample(END_NS, END_NS)[name]
        assert sample.busy_ns == pytest.approx(busy_ns, abs=300_000), "except for a frame that is still on the air"
        assert sample.noise_dbm == pytest.approx(-90.0 if channel.noise_mw[0] == NOISE_MW else -62.2)


def test_the_meter_does_not_change_the_traffic(channel: FixedPowers) -> None:
    without_meter, with_meter = (
        TrafficRun(channel, metered=False),
        TrafficRun(channel, samples_ns=range(0, END_NS, 1_000_000)),
    )
    assert without_meter.log == with_meter.log
    assert without_meter.wifi.sample(END_NS, END_NS) == {}
