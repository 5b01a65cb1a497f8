"""Counters of the stations' drivers: channel busy time, frames, retries, failures, rates."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_backends.radio.frames import Transmission


@dataclass(slots=True)
class LinkMeter:
    """Counters of one directed link.

    Attributes:
        frames: Packets whose first attempt has started.
        retries: Attempts after the first.
        failures: Packets given up after the last attempt.
        rate_bit_s: Rate of the last attempt; None before the first.
    """

    frames: int = 0
    retries: int = 0
    failures: int = 0
    rate_bit_s: int | None = None


class RadioMeter:
    """Counters for stations that share one channel.

    Args:
        stations: Number of stations.
    """

    def __init__(self, stations: int) -> None:
        self._links: dict[tuple[int, int], LinkMeter] = {}
        self._busy_ns = [0] * stations
        self._busy_until_ns = [0] * stations

    def on_start(self, transmission: Transmission, receiver: int | None) -> None:
        """Record a frame that starts now; `receiver` is None for broadcasts and ACKs."""
        start_ns, end_ns = transmission.start_ns, transmission.end_ns
        busy_ns, busy_until_ns = self._busy_ns, self._busy_until_ns
        for index in (transmission.transmitter, *transmission.heard_by):
            until_ns = busy_until_ns[index]
            if end_ns > until_ns:
                busy_ns[index] += end_ns - max(start_ns, until_ns)
                busy_until_ns[index] = end_ns
        if receiver is not None:
            link = self.link(transmission.transmitter, receiver)
            if transmission.attempt == 1:
                link.frames += 1
            else:
                link.retries += 1
            link.rate_bit_s = transmission.mode.rate_bit_s

    def on_failure(self, transmitter: int, receiver: int) -> None:
        """Record that a packet was given up."""
        self.link(transmitter, receiver).failures += 1

    def link(self, transmitter: int, receiver: int) -> LinkMeter:
        """Return the counters of a link, which continue to change."""
        return self._links.setdefault((transmitter, receiver), LinkMeter())

    def busy_ns(self, now_ns: int) -> Sequence[int]:
        """Return the time for which each station found its channel busy until now, by index."""
        return [busy - max(0, until - now_ns) for busy, until in zip(self._busy_ns, self._busy_until_ns, strict=True)]
