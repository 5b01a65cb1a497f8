"""What drivers would count, against the log of every attempt."""

from collections import defaultdict
from collections.abc import Iterable
from itertools import pairwise

import pytest

from fieldkit.core.model import StationSample
from sim_backends.radio.frames import TransmissionAttempt
from sim_backends.radio.modes import G_MODES, SHORT_RETRY_LIMIT
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import NOISE_MW, STRONG_MW, FixedPowers

G54 = G_MODES[-1]
END_NS = 300_000_000


class Talk:
    """Stations a and b that always have something for r, which answers a fourth of it."""

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
        due_ns = [*samples_ns]
        while (now_ns := self.wifi.next_event_ns()) is not None and now_ns < END_NS:
            for at_ns, to, source, _, _ in self.wifi.deliveries(now_ns):
                self.delivered[source, to] += 1
                if to == "r":
                    self.wifi.send(at_ns, source, source, 1000, "r")
                    if self.delivered[source, to] % 4 == 0:
                        self.wifi.send(at_ns, "r", "r", 200, source)
            while due_ns and due_ns[0] <= now_ns:
                due_ns.pop(0)
                self.wifi.sample(now_ns, now_ns)

    def known(self, name: str, other: str) -> StationSample:
        stations = self.wifi.sample(END_NS, END_NS)[name].stations
        return next(one for one in stations if one.station == other)


@pytest.fixture(params=["clear", "noisy", "hidden"])
def channel(request: pytest.FixtureRequest) -> FixedPowers:
    made = FixedPowers("abr", G54, deaf=[("a", "b")] if request.param == "hidden" else [])
    if request.param == "noisy":
        made.noise_mw = [STRONG_MW / 10**2.22] * 3
    return made


def test_attempts_retries_and_packets_are_those_of_the_log(channel: FixedPowers) -> None:
    talk = Talk(channel)
    for name, other in (("a", "r"), ("r", "b")):
        known = talk.known(name, other)
        # A frame whose end is to come is not in the log yet: one at most.
        numbers = [one.number for one in talk.log if (one.transmitter, one.receiver) == (name, other) and one.number]
        assert known.tx_packets is not None
        assert known.tx_retries is not None
        assert 0 <= known.tx_packets - numbers.count(1) <= 1
        assert 0 <= known.tx_packets + known.tx_retries - len(numbers) <= 1
        assert known.tx_rate_bit_s == G54.rate_bit_s
        assert known.signal_dbm == pytest.approx(-40.0)
        assert 0 <= talk.delivered[name, other] - (talk.known(other, name).rx_packets or 0) <= 1
    assert talk.known("r", "b").rx_rate_bit_s == G54.rate_bit_s


def test_a_failure_is_a_last_attempt_without_an_answer(channel: FixedPowers) -> None:
    talk = Talk(channel)
    sent = [one for one in talk.log if one.number == 0 or one.transmitter == "a"]
    last = [
        not (after.number == 0 and after.receiver == "a" and after.received)
        for one, after in pairwise(sent)
        if one.transmitter == "a" and one.number == SHORT_RETRY_LIMIT
    ]
    assert talk.known("a", "r").tx_failures == pytest.approx(sum(last), abs=1)


def test_the_channel_is_busy_while_somebody_is_heard_or_sends(channel: FixedPowers) -> None:
    talk = Talk(channel)
    deaf = {("a", "b"), ("b", "a")} if channel.rows[0][1] == 0 else set()
    for name in "abr":
        heard = [one for one in talk.log if (name, one.transmitter) not in deaf]
        edges = sorted({edge for one in heard for edge in (one.start_ns, one.end_ns)})
        busy_ns = sum(
            stop - start
            for start, stop in pairwise(edges)
            if any(one.start_ns <= start and one.end_ns >= stop for one in heard)
        )
        sample = talk.wifi.sample(END_NS, END_NS)[name]
        assert sample.busy_ns == pytest.approx(busy_ns, abs=300_000), "but for a frame that is still on the air"
        assert sample.noise_dbm == pytest.approx(-90.0 if channel.noise_mw[0] == NOISE_MW else -62.2)


def test_who_is_measured_is_not_changed(channel: FixedPowers) -> None:
    plain, measured = Talk(channel, metered=False), Talk(channel, samples_ns=range(0, END_NS, 1_000_000))
    assert plain.log == measured.log
    assert plain.wifi.sample(END_NS, END_NS) == {}
