"""Stations at work, and their knowledge of the peers that they send to."""

from collections import deque
from typing import Generic

from sim_backends.radio.contention import Contention
from sim_backends.radio.delay import Payload
from sim_backends.radio.frames import Frame, Transmission
from sim_backends.radio.links import LinkCounters
from sim_backends.radio.modes import SHORT_RETRY_LIMIT
from sim_backends.radio.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.rate_control import RateControl


class Station(Generic[Payload]):
    """A station at work.

    Args:
        index: Which it is of the channel's.
        draws: Of its backoff.

    Attributes:
        contention: Its carrier sense and backoff.
        queue: What it has to send; the first is being sent, or waits for the channel.
        following: The frame that it receives.
        sending_until_ns: When its own last frame ends, or ended.
        exchange: Counts exchanges of a frame and its ACK; odd while one is under way.
        offered: Counts the packets that it was given to send.
    """

    __slots__ = (
        "_drawn",
        "_drawn_for",
        "_draws",
        "contention",
        "exchange",
        "following",
        "index",
        "offered",
        "queue",
        "sending_until_ns",
    )

    def __init__(self, index: int, draws: PacketDraws) -> None:
        self.index = index
        self._draws = draws
        self._drawn_for: tuple[PacketIdentity, int] | None = None
        self._drawn = 0
        self.contention = Contention(self._backoff)
        self.queue: deque[Frame[Payload]] = deque()
        self.following: Transmission | None = None
        self.sending_until_ns = 0
        self.exchange = self.offered = 0

    def _backoff(self) -> float:
        """Return the next draw for the frame that it sends, of those after so many attempts."""
        frame = self.queue[0]
        drawn_for = frame.packet, frame.attempts
        # Who drew no slot and finds the channel taken draws again.
        self._drawn = self._drawn + 1 if drawn_for == self._drawn_for else 0
        self._drawn_for = drawn_for
        return self._draws.draw(frame.packet, self._drawn * (SHORT_RETRY_LIMIT + 1) + frame.attempts)


class Peer(Generic[Payload]):
    """What a station knows of another that it sends to, and what became of that.

    Args:
        receiver: Index of the other.
        rate: What chooses modes.

    Attributes:
        last: The frame that came last: a retry whose ACK was lost comes twice.
    """

    __slots__ = ("delivered", "last", "lost", "queue_dropped", "rate", "receiver", "sent")

    def __init__(self, receiver: int, rate: RateControl) -> None:
        self.receiver = receiver
        self.rate = rate
        self.sent = self.queue_dropped = self.lost = self.delivered = 0
        self.last: Frame[Payload] | None = None

    def count(self, *, delivered: bool) -> None:
        """Take in what became of a frame in the end."""
        self.sent += 1
        self.delivered += delivered
        self.lost += not delivered

    @property
    def counters(self) -> LinkCounters:
        """The counters so far."""
        return LinkCounters(self.sent, self.queue_dropped, self.lost, self.delivered)
