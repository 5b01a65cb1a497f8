"""Stations of 802.11 on one channel: DCF with hidden stations, retries, ACKs, relaying by an access point.

An event-driven engine on integer nanoseconds that knows no clock and no socket; its contract is that of
`model.RadioModel`. It leaves out RTS/CTS (drivers switch it off below 2347 bytes), A-MPDU aggregation,
frames sent by the access point as beacons, power save, fragmentation.
"""

from collections.abc import Callable
from itertools import permutations
from typing import Final, Generic

from sim_backends.radio.channel import RadioChannel
from sim_backends.radio.delay import Delay, Delivery, Payload
from sim_backends.radio.event_queue import EventQueue
from sim_backends.radio.frames import HEADER_BYTES, Frame, Transmission, TransmissionAttempt, acknowledgement, attempt
from sim_backends.radio.links import LinkCounters, Pair
from sim_backends.radio.modes import (
    ACK_BYTES,
    BASIC,
    SHORT_RETRY_LIMIT,
    SIFS_NS,
    SLOT_NS,
    Mode,
    ack_ns,
    control_mode,
)
from sim_backends.radio.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.reception import Reception
from sim_backends.radio.stations import Peer, Station

# 10.3.2.11: an ACK that has not begun by then does not come; aRxPHYStartDelay of table 17-21 is 20 us.
_ACK_TIMEOUT_NS: Final = SIFS_NS + SLOT_NS + 20_000


class Wifi(Generic[Payload]):
    """Stations that share one channel.

    Args:
        channel: How they hear each other.
        seed: Of all random draws.
        queue_packets: Packets that wait per station.
    """

    def __init__(self, channel: RadioChannel, seed: int, *, queue_packets: int = 1000) -> None:
        self._channel = channel
        self._queue_packets = queue_packets
        self._log: Callable[[TransmissionAttempt], None] | None = None
        self._index = {name: index for index, name in enumerate(channel.names)}
        self._relay: int | None = None
        self._stations: list[Station[Payload]] = [
            Station(index, PacketDraws(seed, name, "backoff")) for name, index in self._index.items()
        ]
        self._peers: dict[tuple[int, int], Peer[Payload]] = {}
        self._events = EventQueue(self._begin)
        self._reception = Reception(channel, seed, self._stations, self._events)
        self._arrived: list[Delivery[Payload]] = []

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Hand `log` every transmission attempt that ends from now on, or nobody."""
        self._log = log

    def relay(self, name: str | None) -> None:
        """Let this station be the access point from now on, or none."""
        self._relay = None if name is None else self._index[name]

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return what became of the frames on each hop so far; a broadcast is one per station in range."""
        names = self._channel.names
        none = dict.fromkeys(permutations(names, 2), LinkCounters(0, 0, 0, 0))
        return none | {(names[one], names[other]): peer.counters for (one, other), peer in self._peers.items()}

    def send(
        self,
        now_ns: int,
        source: str,
        payload: Payload,
        size_bytes: int,
        destination: str | None,
        *,
        packet: PacketIdentity | None = None,
        before: Delay = 0,
    ) -> None:
        """See `RadioModel.send`."""
        self.advance(now_ns)
        station = self._stations[self._index[source]]
        receiver = None if destination is None else self._index[destination]
        identity = packet or (source, station.offered)
        station.offered += 1
        relay = self._relay
        if relay is None or relay in {station.index, receiver}:
            frame = Frame(payload, size_bytes, source, receiver, (), True, identity, now_ns, before)
        else:
            kept = receiver is None
            frame = Frame(payload, size_bytes, source, relay, (receiver,), kept, identity, now_ns, before)
        self._enqueue(now_ns, station, frame)

    def next_event_ns(self) -> int | None:
        """Return when `deliveries` has something to do next, None when nothing is under way."""
        return self._events.next_ns()

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return what arrived up to `now_ns` and was not returned before, in order of arrival."""
        self.advance(now_ns)
        arrived, self._arrived = self._arrived, []
        return arrived

    def advance(self, now_ns: int) -> None:
        """Let everything happen up to `now_ns`."""
        self._events.advance(now_ns)

    def _enqueue(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        queue = station.queue
        peer = None if frame.receiver is None else self._peer(station.index, frame.receiver)
        if peer is not None and not self._channel.linked(station.index, peer.receiver):
            peer.sent += 1
            peer.lost += 1
            return
        if len(queue) > self._queue_packets:
            if peer is not None:
                peer.queue_dropped += 1
            return
        queue.append(frame)
        if len(queue) == 1 and not station.exchange & 1:
            self._contend(now_ns, station)

    def _contend(self, now_ns: int, station: Station[Payload]) -> None:
        self._events.begin(station.contention.wanted(now_ns), station.index)

    def _begin(self, now_ns: int, index: int) -> None:
        station = self._stations[index]
        station.contention.wanted(now_ns)
        station.exchange += 1
        frame = station.queue[0]
        if not frame.attempts:
            frame.begun_ns = now_ns
        frame.attempts += 1
        receiver, packet, number = frame.receiver, frame.packet, frame.attempts
        mode = BASIC if receiver is None else self._peer(station.index, receiver).rate.choose(now_ns, packet, number)
        size_bytes = frame.size_bytes + HEADER_BYTES
        end_ns = now_ns + mode.airtime_ns(size_bytes)
        reserved_ns = end_ns if receiver is None else end_ns + SIFS_NS + ack_ns(mode)
        transmission = Transmission(station.index, now_ns, end_ns, mode, size_bytes, packet, number)
        self._reception.begin(transmission, reserved_ns)
        self._events.at(end_ns, self._sent, station, frame, transmission)

    def _sent(
        self, now_ns: int, station: Station[Payload], frame: Frame[Payload], transmission: Transmission
    ) -> None:
        receiver = frame.receiver
        aimed_at = sorted(transmission.followed_by) if receiver is None else [receiver]
        received = [index for index in aimed_at if self._reception.decodes(index, transmission, "data")]
        self._reception.end(now_ns, transmission)
        if self._log is not None:
            self._log(attempt(self._channel.names, transmission, frame, received))
        for index in received:
            self._receive(now_ns, station.index, index, frame)
        if receiver is None:
            for index in range(len(self._stations)):
                if self._channel.linked(station.index, index):
                    self._peer(station.index, index).count(delivered=index in received)
            self._end(now_ns, station, done=True)
        else:
            if received:
                self._events.at(now_ns + SIFS_NS, self._acknowledge, self._stations[receiver], station, transmission)
            self._events.at(now_ns + _ACK_TIMEOUT_NS, self._unanswered, station, station.exchange, transmission.mode)

    def _acknowledge(
        self, now_ns: int, receiver: Station[Payload], station: Station[Payload], transmission: Transmission
    ) -> None:
        if receiver.sending_until_ns > now_ns:
            return
        mode = transmission.mode
        end_ns = now_ns + ack_ns(mode)
        packet, number = transmission.packet, transmission.attempt
        ack = Transmission(receiver.index, now_ns, end_ns, control_mode(mode), ACK_BYTES, packet, number)
        self._reception.begin(ack, end_ns)
        if station.following is ack:
            station.exchange += 2  # so that it no longer counts as unanswered
        self._events.at(end_ns, self._acknowledged, station, ack, mode, station.exchange)

    def _acknowledged(
        self, now_ns: int, station: Station[Payload], ack: Transmission, mode: Mode, exchange: int
    ) -> None:
        followed = station.following is ack
        decoded = followed and self._reception.decodes(station.index, ack, "ack")
        self._reception.end(now_ns, ack)
        if self._log is not None:
            self._log(acknowledgement(self._channel.names, ack, station.index, decoded=decoded))
        if followed and exchange == station.exchange:
            self._answer(now_ns, station, mode, acknowledged=decoded)

    def _unanswered(self, now_ns: int, station: Station[Payload], exchange: int, mode: Mode) -> None:
        if exchange == station.exchange:
            self._answer(now_ns, station, mode, acknowledged=False)

    def _answer(self, now_ns: int, station: Station[Payload], mode: Mode, *, acknowledged: bool) -> None:
        frame = station.queue[0]
        assert frame.receiver is not None
        peer = self._peer(station.index, frame.receiver)
        peer.rate.tell(mode, acknowledged=acknowledged)
        if not acknowledged:
            station.contention.sent(now_ns)
        done = acknowledged or frame.attempts >= SHORT_RETRY_LIMIT
        if done:
            peer.count(delivered=peer.last is frame)
        self._end(now_ns, station, done=done)

    def _end(self, now_ns: int, station: Station[Payload], *, done: bool) -> None:
        station.exchange += 1
        if done:
            station.contention.succeeded()
            station.queue.popleft()
        else:
            station.contention.failed()
        if station.queue:
            self._contend(now_ns, station)

    def _receive(self, now_ns: int, transmitter: int, receiver: int, frame: Frame[Payload]) -> None:
        peer = self._peer(transmitter, receiver)
        if peer.last is frame:
            return
        peer.last = frame
        wave_ns = self._channel.delay_ns(transmitter, receiver)
        passed = frame.delayed(now_ns, wave_ns)
        if frame.keep:
            self._events.at(now_ns + wave_ns, self._deliver, receiver, frame.payload, frame.source, passed)
        for onward in frame.onward:
            self._enqueue(now_ns, self._stations[receiver], frame.passed_on(now_ns, onward, passed))

    def _deliver(self, now_ns: int, receiver: int, payload: Payload, source: str, passed: Delay) -> None:
        name = self._channel.names[receiver]
        if name != source:  # an access point repeats a broadcast to who sent it, too
            self._arrived.append((now_ns, name, payload, source, passed))

    def _peer(self, transmitter: int, receiver: int) -> Peer[Payload]:
        pair = transmitter, receiver
        if pair not in self._peers:
            self._peers[pair] = Peer(receiver, self._channel.rate_control(*pair))
        return self._peers[pair]
