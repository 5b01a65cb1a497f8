"""Stations at work, and their knowledge of the peers that they send to."""

from collections import deque
from typing import Generic

from sim_backends.radio.contention import Contention
from sim_backends.radio.delay import Payload
from sim_backends.radio.frames import Frame, Transmission
from sim_backends.radio.links import LinkCounters
from sim_backends.radio.rate_control import RateControl


class Station(Generic[Payload]):
    """A station at work.

    Args:
        index: Which it is of the channel's.
        contention: Its carrier sense and backoff.

    Attributes:
        queue: What it has to send; the first is being sent, or waits for the channel.
        following: The frame that it receives.
        sending_until_ns: When its own last frame ends, or ended.
        exchange: Counts exchanges of a frame and its ACK; odd while one is under way.
    """

    __slots__ = ("contention", "exchange", "following", "index", "queue", "sending_until_ns")

    def __init__(self, index: int, contention: Contention) -> None:
        self.index = index
        self.contention = contention
        self.queue: deque[Frame[Payload]] = deque()
        self.following: Transmission | None = None
        self.sending_until_ns = 0
        self.exchange = 0


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
