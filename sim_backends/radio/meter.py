"""Counters of stations' drivers: the time that their channel was busy, frames, retries, failures, rates."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_backends.radio.frames import Transmission


@dataclass(slots=True)
class LinkMeter:
    """Counts of one directed link.

    Attributes:
        frames: Packets whose first attempt began.
        retries: Attempts after the first.
        failures: Packets given up after the last.
        rate_bit_s: Rate of the last attempt; None before any.
    """

    frames: int = 0
    retries: int = 0
    failures: int = 0
    rate_bit_s: int | None = None


class RadioMeter:
    """Counts for stations that share one channel.

    Args:
        stations: How many there are.
    """

    def __init__(self, stations: int) -> None:
        self._links: dict[tuple[int, int], LinkMeter] = {}
        self._busy_ns = [0] * stations
        self._busy_until_ns = [0] * stations

    def begun(self, transmission: Transmission, receiver: int | None) -> None:
        """Take in a frame whose first symbol goes on the air now; None is everyone, or an ACK's receiver."""
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

    def failed(self, transmitter: int, receiver: int) -> None:
        """Take in that a packet was given up."""
        self.link(transmitter, receiver).failures += 1

    def link(self, transmitter: int, receiver: int) -> LinkMeter:
        """Return the counts of a link, which go on."""
        return self._links.setdefault((transmitter, receiver), LinkMeter())

    def busy_ns(self, now_ns: int) -> Sequence[int]:
        """Return for how long each station found its channel busy until now, by index."""
        return [busy - max(0, until - now_ns) for busy, until in zip(self._busy_ns, self._busy_until_ns, strict=True)]
