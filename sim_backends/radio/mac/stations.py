"""State of the stations, and of their links to the peers to which they send."""

from collections import deque
from functools import partial
from typing import Generic

from typing_extensions import override

from fieldkit.config.wifi_phy import DscpMapping
from sim_backends.radio.core.links import LinkCounters, Payload
from sim_backends.radio.core.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.mac.aggregation import Aggregate, BlockAckSession
from sim_backends.radio.mac.contention import ChannelAccess, Contention
from sim_backends.radio.mac.edca import AccessCategories
from sim_backends.radio.mac.frames import Frame
from sim_backends.radio.phy.modes import SHORT_RETRY_LIMIT, Band, WifiMode
from sim_backends.radio.phy.transmissions import Transmission
from sim_backends.radio.rate_control.rate_control import RateControl


class Station(Generic[Payload]):
    """The state of a station.

    Args:
        index: Its index in the channel's list of stations.
        draws: Random draws of its backoff.
        ifs_ns: Inter-frame space before its backoff.
        rts_threshold_bytes: Size of the largest frame or aggregate that it sends without RTS.

    Attributes:
        contention: Its carrier sense and backoff.
        queue: Frames to send; the first is being sent, or waits for the channel.
        receiving: The frame that it is receiving; None if it receives none.
        sending_until_ns: End of its last or current frame.
        exchange_id: Number that increases at the start and the end of each exchange of a frame and its ACK; odd
            during an exchange.
        packet_count: Number of packets that were passed to it for sending.
        aggregate: The aggregate of its current exchange; None between exchanges, and for a frame without a session.
        rts_threshold_bytes: Size of the largest frame or aggregate that it sends without RTS.
        categories: Its access categories (`queue` belongs to the active one); None if it has only one queue.
    """

    __slots__ = (
        "_draws",
        "_redraws",
        "_redraws_of",
        "aggregate",
        "categories",
        "contention",
        "exchange_id",
        "index",
        "packet_count",
        "queue",
        "receiving",
        "rts_threshold_bytes",
        "sending_until_ns",
    )

    def __init__(self, index: int, draws: PacketDraws, ifs_ns: int, rts_threshold_bytes: int) -> None:
        self.index = index
        self._draws = draws
        # The attempt for which a backoff was drawn last, and the number of further backoffs drawn for it.
        self._redraws_of: tuple[PacketIdentity, int] | None = None
        self._redraws = 0
        self.queue: deque[Frame[Payload]] = deque()
        self.contention: ChannelAccess = Contention(partial(self._backoff, self.queue), ifs_ns)
        self.categories: AccessCategories[Payload] | None = None
        self.receiving: Transmission | None = None
        self.aggregate: Aggregate[Payload] | None = None
        self.sending_until_ns = 0
        self.rts_threshold_bytes = rts_threshold_bytes
        self.exchange_id = self.packet_count = 0

    @property
    def is_in_exchange(self) -> bool:
        """True from the start to the end of an exchange."""
        return bool(self.exchange_id & 1)

    @property
    def has_frames(self) -> bool:
        """True if any of its queues has frames."""
        return bool(self.queue) if self.categories is None else self.categories.has_frames()

    def use_categories(self, mapping: DscpMapping, band: Band) -> None:
        """Use the queues and the contention of the access categories instead of the single queue."""
        self.contention = self.categories = AccessCategories(mapping, band, self._backoff)
        self.queue = self.categories.active.frames

    def _backoff(self, queue: deque[Frame[Payload]]) -> float:
        """Return the random draw of the backoff for the next attempt at the first frame in a queue."""
        frame = queue[0]
        attempt = frame.packet, frame.attempts
        # A station that drew 0 slots and finds the channel busy draws again.
        self._redraws = self._redraws + 1 if attempt == self._redraws_of else 0
        self._redraws_of = attempt
        # Each redraw and each attempt has its own draw.
        return self._draws.draw(frame.packet, self._redraws * (SHORT_RETRY_LIMIT + 1) + frame.attempts)


class Peer(Generic[Payload]):
    """The state of a link from a station to a peer, and its counters.

    Args:
        receiver: Index of the peer.
        rate: Rate control of the link.
        session: Block Ack session of the link; None if its frames are not aggregated.

    Attributes:
        failed_exchanges: Number of aggregates without a Block Ack since the last Block Ack.
        last_frame: The last frame that the peer received; a retry after a lost ACK is a duplicate of it.
        mode: Mode of the last attempt; not set before the first.
    """

    __slots__ = (
        "delivered",
        "failed_exchanges",
        "last_frame",
        "lost",
        "mode",
        "queue_dropped",
        "rate",
        "receiver",
        "sent",
        "session",
    )

    def __init__(self, receiver: int, rate: RateControl, session: BlockAckSession[Payload] | None) -> None:
        self.receiver = receiver
        self.rate = rate
        self.session = session
        self.sent = self.queue_dropped = self.lost = self.delivered = 0
        self.failed_exchanges = 0
        self.mode: WifiMode
        self.last_frame: Frame[Payload] | None = None

    def has_received(self, frame: Frame[Payload]) -> bool:
        """Return True if the peer has decoded a frame, even if its acknowledgement was lost."""
        return frame.is_received or self.last_frame is frame

    def count_frames(self, *, delivered: int, lost: int) -> None:
        """Count the final results of the frames of an aggregate."""
        self.sent += delivered + lost
        self.delivered += delivered
        self.lost += lost

    def count(self, *, delivered: bool) -> None:
        """Count the final result of a frame."""
        self.sent += 1
        self.delivered += delivered
        self.lost += not delivered

    @property
    def counters(self) -> LinkCounters:
        """The current counters."""
        return LinkCounters(self.sent, self.queue_dropped, self.lost, self.delivered)


class CategoryPeer(Peer[Payload]):
    """The state of a link in one access category other than best effort.

    Args:
        link: State of the link, which has the counters and the rate control.
        session: Block Ack session of the category; None if its frames are not aggregated.
    """

    __slots__ = ("_link",)

    def __init__(self, link: Peer[Payload], session: BlockAckSession[Payload] | None) -> None:
        super().__init__(link.receiver, link.rate, session)
        self._link = link

    @override
    def count_frames(self, *, delivered: int, lost: int) -> None:
        self._link.count_frames(delivered=delivered, lost=lost)

    @override
    def count(self, *, delivered: bool) -> None:
        self._link.count(delivered=delivered)
