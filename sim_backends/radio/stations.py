"""State of the stations, of their links to the peers to which they send, and the counters of their drivers."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic

from sim_backends.radio.contention import Contention
from sim_backends.radio.frames import Frame, Transmission
from sim_backends.radio.links import LinkCounters, Payload
from sim_backends.radio.modes import SHORT_RETRY_LIMIT
from sim_backends.radio.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.rate_control import RateControl


class Station(Generic[Payload]):
    """The state of a station.

    Args:
        index: Its index in the channel's list of stations.
        draws: Random draws of its backoff.
        ifs_ns: Inter-frame space before its backoff.

    Attributes:
        contention: Its carrier sense and backoff.
        queue: Frames to send; the first is being sent, or waits for the channel.
        receiving: The frame that it is receiving.
        sending_until_ns: End of its last or current frame.
        exchange_id: Number that increases at the start and the end of each exchange of a frame and its ACK; odd
            during an exchange.
        offered: Number of packets that were passed to it for sending.
    """

    __slots__ = (
        "_draws",
        "_redraws",
        "_redraws_of",
        "contention",
        "exchange_id",
        "index",
        "offered",
        "queue",
        "receiving",
        "sending_until_ns",
    )

    def __init__(self, index: int, draws: PacketDraws, ifs_ns: int) -> None:
        self.index = index
        self._draws = draws
        self._redraws_of: tuple[PacketIdentity, int] | None = None
        self._redraws = 0
        self.contention = Contention(self._backoff, ifs_ns)
        self.queue: deque[Frame[Payload]] = deque()
        self.receiving: Transmission | None = None
        self.sending_until_ns = 0
        self.exchange_id = self.offered = 0

    def _backoff(self) -> float:
        """Return the next random draw for the first frame in the queue after its current number of attempts."""
        frame = self.queue[0]
        attempt = frame.packet, frame.attempts
        # A station that drew 0 slots and finds the channel busy draws again.
        self._redraws = self._redraws + 1 if attempt == self._redraws_of else 0
        self._redraws_of = attempt
        return self._draws.draw(frame.packet, self._redraws * (SHORT_RETRY_LIMIT + 1) + frame.attempts)


class Peer(Generic[Payload]):
    """The state of a link from a station to a peer, and its counters.

    Args:
        receiver: Index of the peer.
        rate: Rate control of the link.

    Attributes:
        last_frame: The last frame that the peer received; a retry after a lost ACK is a duplicate of it.
    """

    __slots__ = ("delivered", "last_frame", "lost", "queue_dropped", "rate", "receiver", "sent")

    def __init__(self, receiver: int, rate: RateControl) -> None:
        self.receiver = receiver
        self.rate = rate
        self.sent = self.queue_dropped = self.lost = self.delivered = 0
        self.last_frame: Frame[Payload] | None = None

    def count(self, *, delivered: bool) -> None:
        """Count the final result of a frame."""
        self.sent += 1
        self.delivered += delivered
        self.lost += not delivered

    @property
    def counters(self) -> LinkCounters:
        """The counters so far."""
        return LinkCounters(self.sent, self.queue_dropped, self.lost, self.delivered)


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
        for index in (transmission.transmitter, *transmission.detected_by):
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
