"""Packets above the frame exchange: queues of the stations, relaying, delivery, and the log of losses."""

from collections.abc import Iterable, Sequence
from typing import Generic

from sim_backends.radio.core.links import (
    NOT_DECODED,
    OUT_OF_RANGE,
    QUEUE_FULL,
    RADIO_OFF,
    Delay,
    Delivery,
    LossLog,
    Payload,
)
from sim_backends.radio.mac.aggregation import BlockAckSession
from sim_backends.radio.mac.amsdu import AmsduSession
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.mac.edca import category_of
from sim_backends.radio.mac.frames import Frame
from sim_backends.radio.mac.power_save import PowerSave
from sim_backends.radio.mac.stations import CategoryPeer, Peer, Station


class PacketDelivery(Generic[Payload]):
    """The packets of stations that share one channel.

    Args:
        channel: Received powers between the stations.
        stations: Stations by index.
        events: Scheduled events.
        queue_packets: Maximum number of packets in each queue of a station, without the first.

    Attributes:
        peers: State of each link that was used, by indices of transmitter and receiver.
        deliveries: Delivered packets, in order of arrival.
        log_loss: Called for every loss; None without a log.
        power_save: The dozing stations; None if no station uses power save.
    """

    def __init__(
        self,
        channel: RadioChannel,
        stations: Sequence[Station[Payload]],
        events: EventQueue,
        queue_packets: int,
    ) -> None:
        self._channel = channel
        self._stations = stations
        self._events = events
        self._queue_packets = queue_packets
        self.peers: dict[tuple[int, int], Peer[Payload]] = {}
        self._category_peers: dict[tuple[int, int, int], CategoryPeer[Payload]] = {}
        self.deliveries: list[Delivery[Payload]] = []
        self.log_loss: LossLog | None = None
        self.power_save: PowerSave[Payload] | None = None

    def enqueue(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        """Buffer a frame for a dozing receiver, or pass it to `enqueue_now`."""
        if self.power_save is None or not self.power_save.buffer(now_ns, station, frame):
            self.enqueue_now(now_ns, station, frame)

    def enqueue_now(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        """Queue a frame for its next hop, or drop it if the queue is full or the receiver is out of range."""
        queue = station.queue
        if station.categories is not None:
            frame.category = category_of(frame.dscp, station.categories.mapping)
            queue = station.categories.queue_of(frame)
        peer = None if frame.receiver is None else self.peer(station.index, frame.receiver)
        if peer is not None and not self._channel.are_linked(station.index, peer.receiver):
            peer.count(delivered=False)
            self.lose(now_ns, station.index, frame, OUT_OF_RANGE)
            return
        # The first frame, which is being sent or waits for the channel, is not counted.
        if len(queue) > self._queue_packets:
            if peer is not None:
                peer.queue_dropped += 1
            self.lose(now_ns, station.index, frame, QUEUE_FULL)
            return
        queue.append(frame)
        if len(queue) == 1:
            if station.categories is not None:
                station.categories.arrive(now_ns, frame, in_exchange=station.is_in_exchange)
            if not station.is_in_exchange:
                self._events.schedule_start(station.contention.earliest_start_ns(now_ns), station.index)

    def discard_queue(self, now_ns: int, station: Station[Payload]) -> None:
        """Empty the queues of a station whose radio was switched off; frames that were not received are lost."""
        if self.power_save is not None:
            for frame in self.power_save.discard(station):
                self._discard(now_ns, station, frame)
        for queue in (station.queue,) if station.categories is None else station.categories.queues:
            while queue:
                self._discard(now_ns, station, queue.popleft())

    def _discard(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        peer = None if frame.receiver is None else self.peer(station.index, frame.receiver, frame.category)
        if peer is None or not peer.has_received(frame):
            self.lose(now_ns, station.index, frame, RADIO_OFF)
            if peer is not None and peer.session is not None:
                self.pass_up(now_ns, station.index, peer, peer.session.skip([frame]))

    def pass_up(self, now_ns: int, transmitter: int, peer: Peer[Payload], frames: Iterable[Frame[Payload]]) -> None:
        """Deliver frames at a receiver, or queue them for their second hop."""
        receiver = peer.receiver
        propagation_ns = self._channel.delay_ns(transmitter, receiver)
        for frame in frames:
            delay = frame.total_delay(now_ns, propagation_ns)
            if frame.is_for_receiver:
                self._events.schedule(
                    now_ns + propagation_ns, self._deliver, receiver, frame.payload, frame.source, delay
                )
            for next_receiver in frame.forward_to:
                self.enqueue(now_ns, self._stations[receiver], frame.for_second_hop(now_ns, next_receiver, delay))

    def _deliver(self, now_ns: int, receiver: int, payload: Payload, source: str, delay: Delay) -> None:
        name = self._channel.names[receiver]
        if name != source:  # an access point also repeats a broadcast to its sender
            self.deliveries.append((now_ns, name, payload, source, delay))

    def count_broadcast(self, now_ns: int, transmitter: int, frame: Frame[Payload], received: list[int]) -> None:
        """Count a broadcast on the link to each station in range, and log its loss for stations that missed it."""
        self.count_receptions(now_ns, transmitter, frame, received, range(len(self._channel.names)))

    def count_receptions(
        self,
        now_ns: int,
        transmitter: int,
        frame: Frame[Payload],
        received: Sequence[int],
        addressed_stations: Iterable[int],
    ) -> None:
        """Count a broadcast on the links to addressed stations in range; log its loss for all that missed it."""
        for index in addressed_stations:
            name = self._channel.names[index]
            is_linked, is_missed = self._channel.are_linked(transmitter, index), index not in received
            if is_linked:
                self.peer(transmitter, index).count(delivered=not is_missed)
            if is_missed and index != transmitter and self.log_loss is not None and name != frame.source:
                self.log_loss(now_ns, frame.payload, name, NOT_DECODED if is_linked else OUT_OF_RANGE)

    def lose(self, now_ns: int, transmitter: int, frame: Frame[Payload], reason: str) -> None:
        """Log the loss of a frame at `transmitter`, for each station that it would have reached."""
        if self.log_loss is None:
            return
        for name in self._intended_receivers(transmitter, frame):
            self.log_loss(now_ns, frame.payload, name, reason)

    def _intended_receivers(self, transmitter: int, frame: Frame[Payload]) -> Iterable[str]:
        names = self._channel.names
        ends = frame.forward_to or (frame.receiver,)
        if ends == (None,):
            return [name for name in names if name not in {frame.source, names[transmitter]}]
        return [names[index] for index in ends if index is not None]

    def peer(self, transmitter: int, receiver: int, category: int = 0) -> Peer[Payload]:
        """Return the state of a link in an access category; the state is created when it is first requested."""
        pair = transmitter, receiver
        peer = self.peers.get(pair)
        if peer is None:
            peer = self.peers[pair] = Peer(receiver, self._channel.rate_control(*pair), self._session(*pair))
        return self._category_peer(transmitter, peer, category) if category else peer

    def _category_peer(self, transmitter: int, link: Peer[Payload], category: int) -> Peer[Payload]:
        key = transmitter, link.receiver, category
        peer = self._category_peers.get(key)
        if peer is None:
            session = self._session(transmitter, link.receiver)
            peer = self._category_peers[key] = CategoryPeer(link, session)
        return peer

    def _session(self, transmitter: int, receiver: int) -> BlockAckSession[Payload] | None:
        limits = self._channel.ampdu_limits(transmitter, receiver)
        if limits is None:
            return None
        return AmsduSession(limits) if limits.amsdu_bytes else BlockAckSession(limits)
