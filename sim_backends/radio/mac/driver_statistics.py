"""Counters as real radio drivers report them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fieldkit.core.model import LinkSample, StationSample
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.frames import Frame
from sim_backends.radio.mac.stations import Peer
from sim_backends.radio.phy.transmissions import Transmission, decibel

_Peers = Mapping[tuple[int, int], Peer[Any]]


@dataclass(slots=True)
class LinkMeter:
    """Counters of one directed link.

    Attributes:
        frames: Packets whose first attempt has started.
        retries: Attempts after the first.
        failures: Packets given up after the last attempt.
        rate_bit_s: Rate of the last attempt in which the data was sent (not only an RTS); None before the first.
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
        """Record a frame that starts now; `receiver` is None for broadcasts, control frames and aggregates."""
        self.on_busy(
            transmission.start_ns, transmission.end_ns, (transmission.transmitter, *transmission.detected_by)
        )
        if receiver is not None:
            link = self.link(transmission.transmitter, receiver)
            if transmission.attempt == 1:
                link.frames += 1
            else:
                link.retries += 1
            link.rate_bit_s = transmission.mode.rate_bit_s

    def on_busy(self, start_ns: int, end_ns: int, stations: Iterable[int]) -> None:
        """Record that the channel is busy between two times at these stations."""
        busy_ns, busy_until_ns = self._busy_ns, self._busy_until_ns
        for index in stations:
            until_ns = busy_until_ns[index]
            if end_ns > until_ns:
                busy_ns[index] += end_ns - max(start_ns, until_ns)
                busy_until_ns[index] = end_ns

    def on_aggregate(self, transmission: Transmission, receiver: int, frames: Sequence[Frame[Any]]) -> None:
        """Record the frames of an aggregate that starts now, after `on_start`."""
        link = self.link(transmission.transmitter, receiver)
        first_attempts = sum(frame.attempts == 1 for frame in frames)
        link.frames += first_attempts
        link.retries += len(frames) - first_attempts
        link.rate_bit_s = transmission.mode.rate_bit_s

    def on_failed_rts(self, transmitter: int, receiver: int, frames: Sequence[Frame[Any]]) -> None:
        """Record an attempt that ended without CTS, for frames whose data was not sent."""
        link = self.link(transmitter, receiver)
        first_attempts = sum(frame.attempts == 1 for frame in frames)
        link.frames += first_attempts
        link.retries += len(frames) - first_attempts

    def on_failures(self, transmitter: int, receiver: int, packets: int) -> None:
        """Record that packets were given up."""
        self.link(transmitter, receiver).failures += packets

    def link(self, transmitter: int, receiver: int) -> LinkMeter:
        """Return the counters of a link; later frames change the returned object."""
        return self._links.setdefault((transmitter, receiver), LinkMeter())

    def busy_ns(self, now_ns: int) -> Sequence[int]:
        """Return the time for which the channel of each station has been busy, by index."""
        return [busy - max(0, until - now_ns) for busy, until in zip(self._busy_ns, self._busy_until_ns, strict=True)]


def link_samples(
    now_ns: int,
    utc_ns: int,
    channel: RadioChannel,
    meter: RadioMeter,
    peers: _Peers,
    *,
    robots: Sequence[int],
    relay: int | None,
    cells: Mapping[int, int | None] | None = None,
) -> dict[str, LinkSample]:
    """Return the driver statistics of each robot, with the timestamp `utc_ns`.

    Args:
        now_ns: Current time.
        utc_ns: Timestamp.
        channel: The channel.
        meter: The counters.
        peers: The links, by indices of transmitter and receiver.
        robots: Indices of the robots.
        relay: Index of the access point; None for direct links.
        cells: Access point of each robot, if the robots roam between access points.
    """
    busy_ns = meter.busy_ns(now_ns)

    def peers_of(index: int) -> Sequence[int]:
        """Return the stations to which a robot sends frames: all other robots, or its access point if it has one."""
        if cells is not None:
            access_point = cells[index]
            return [] if access_point is None else [access_point]
        return [other for other in (robots if relay in {None, index} else (relay,)) if other not in {None, index}]

    def cell_of(index: int) -> str | None:
        access_point = None if cells is None else cells[index]
        return None if access_point is None else channel.names[access_point]

    return {
        channel.names[index]: LinkSample(
            utc_ns,
            tuple(_station_sample(now_ns, channel, meter, peers, (index, other)) for other in peers_of(index)),
            cell=cell_of(index),
            noise_dbm=decibel(channel.noise_mw[index]),
            active_ns=now_ns,
            busy_ns=busy_ns[index],
        )
        for index in robots
    }


def _station_sample(
    now_ns: int, channel: RadioChannel, meter: RadioMeter, peers: _Peers, link: tuple[int, int]
) -> StationSample:
    index, other = link
    forward, reverse, peer = meter.link(index, other), meter.link(other, index), peers.get((other, index))
    return StationSample(
        station=channel.names[other],
        signal_dbm=decibel(channel.powers_mw(other, now_ns)[index]) if channel.are_linked(other, index) else None,
        tx_rate_bit_s=forward.rate_bit_s,
        rx_rate_bit_s=reverse.rate_bit_s,
        tx_packets=forward.frames,
        rx_packets=0 if peer is None else peer.delivered,
        tx_retries=forward.retries,
        tx_failures=forward.failures,
    )
