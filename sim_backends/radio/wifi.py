"""802.11 stations on one channel: DCF with hidden stations, retries, ACKs, relaying by an access point.

An event-driven engine on integer nanoseconds that uses no clock and no socket; its interface is `model.RadioModel`.
Frames between stations with `phy` are aggregated. It does not model RTS/CTS (drivers switch it off below 2347 bytes),
other access categories than best effort, beacons of the access point, power save and fragmentation.
"""

from collections.abc import Callable, Iterable, Mapping, Set
from itertools import permutations
from typing import Final, Generic

from fieldkit.core.model import LinkSample
from sim_backends.radio.aggregation import QOS_HEADER_BYTES, Aggregate, BlockAckSession, remove_frames
from sim_backends.radio.channel import RadioChannel
from sim_backends.radio.contention import EventQueue
from sim_backends.radio.driver_statistics import RadioMeter, link_samples
from sim_backends.radio.frames import (
    HEADER_BYTES,
    Emission,
    Frame,
    Transmission,
    TransmissionAttempt,
    ack_record,
    attempt_record,
)
from sim_backends.radio.links import (
    NOT_DECODED,
    OUT_OF_RANGE,
    QUEUE_FULL,
    RADIO_OFF,
    RETRIES_EXHAUSTED,
    Delay,
    Delivery,
    LinkCounters,
    LossLog,
    Pair,
    Payload,
)
from sim_backends.radio.modes import (
    SHORT_RETRY_LIMIT,
    SLOT_NS,
    WifiMode,
    ack_ns,
    basic_mode,
    control_mode,
    response_ns,
)
from sim_backends.radio.random_streams import PacketDraws, PacketIdentity
from sim_backends.radio.reception import Reception
from sim_backends.radio.stations import Peer, Station

# 10.3.2.11: an ACK that has not started by then does not arrive; aRxPHYStartDelay of table 17-21 is 20 us.
_ACK_TIMEOUT_AFTER_SIFS_NS: Final = SLOT_NS + 20_000

# Retry interval of a station that finds the channel jammed; a robot hardly moves in this time.
_JAMMED_RETRY_NS: Final = 1_000_000


class Wifi(Generic[Payload]):
    """Stations that share one channel.

    Args:
        channel: Received powers between the stations.
        seed: Seed of all random draws.
        queue_packets: Maximum number of queued packets per station.
    """

    def __init__(self, channel: RadioChannel, seed: int, *, queue_packets: int = 1000) -> None:
        self._channel = channel
        self._queue_packets = queue_packets
        self._log: Callable[[TransmissionAttempt], None] | None = None
        self._log_loss: LossLog | None = None
        self._meter: RadioMeter | None = None
        self._off: Set[str] = frozenset()
        self._index = {name: index for index, name in enumerate(channel.names)}
        self._relay: int | None = None
        band = channel.band
        self._basic = basic_mode(band)
        self._sifs_ns = band.sifs_ns
        self._ack_timeout_ns = band.sifs_ns + _ACK_TIMEOUT_AFTER_SIFS_NS
        self._stations: list[Station[Payload]] = [
            Station(index, PacketDraws(seed, name, "backoff"), channel.ifs_ns(index))
            for name, index in self._index.items()
        ]
        self._peers: dict[tuple[int, int], Peer[Payload]] = {}
        self._events = EventQueue(self._start_transmission)
        self._reception = Reception(channel, seed, self._stations, self._events)
        self._arrived: list[Delivery[Payload]] = []

    def log_attempts(self, log: Callable[[TransmissionAttempt], None] | None) -> None:
        """Pass every transmission attempt that ends from now on to `log`; None stops logging."""
        self._log = log

    def log_losses(self, log: LossLog | None) -> None:
        """Pass every loss from now on to `log`; None stops logging."""
        self._log_loss = log

    def use_meter(self) -> None:
        """Start the counters of the radio drivers, for `sample`."""
        self._meter = RadioMeter(len(self._stations))

    def sample(self, now_ns: int, utc_ns: int) -> dict[str, LinkSample]:
        """Implement `RadioModel.sample`."""
        self.advance(now_ns)
        if self._meter is None:
            return {}
        return link_samples(now_ns, utc_ns, self._channel, self._meter, self._peers, relay=self._relay)

    def switch_off(self, now_ns: int, names: Set[str]) -> None:
        """Set the stations whose radios are off; the caller must also put them out of range of all others.

        Frames queued at a station that is switched off are lost, and its current transmission is aborted.
        """
        self.advance(now_ns)
        for name in sorted(names - self._off):
            station = self._stations[self._index[name]]
            self._reception.abort(station.index, now_ns)
            self._events.cancel_start(station.index)
            station.exchange_id += station.exchange_id & 1
            station.aggregate = None
            while station.queue:
                frame = station.queue.popleft()
                peer = None if frame.receiver is None else self._peer(station.index, frame.receiver)
                if peer is None or not peer.has_received(frame):
                    self._lose(now_ns, station.index, frame, RADIO_OFF)
                    if peer is not None and peer.session is not None:
                        self._pass_up(now_ns, station.index, peer, peer.session.skip([frame]))
        self._off = frozenset(names)

    def set_emissions(self, now_ns: int, emissions: Mapping[str, Emission]) -> None:
        """Set the jammer noise that is on the air from now on, by jammer name."""
        self.advance(now_ns)
        self._reception.set_emissions(now_ns, emissions)
        if not emissions:
            for station in self._stations:
                self._retry_when_idle(now_ns, station)

    def set_relay(self, name: str | None) -> None:
        """Set the station that is the access point from now on; None for direct links."""
        self._relay = None if name is None else self._index[name]

    def counters(self) -> dict[Pair, LinkCounters]:
        """Return the counters of each hop so far; a broadcast counts as one frame per station in range."""
        names = self._channel.names
        zeros = dict.fromkeys(permutations(names, 2), LinkCounters(0, 0, 0, 0))
        return zeros | {
            (names[transmitter], names[receiver]): peer.counters
            for (transmitter, receiver), peer in self._peers.items()
        }

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
        max_attempts: int = SHORT_RETRY_LIMIT,
    ) -> None:
        """Implement `RadioModel.send`; after `max_attempts` on its first hop the packet is given up."""
        self.advance(now_ns)
        station = self._stations[self._index[source]]
        receiver = None if destination is None else self._index[destination]
        identity = packet or (source, station.offered)
        station.offered += 1
        relay = self._relay
        if relay is None or relay in {station.index, receiver}:
            frame = Frame(payload, size_bytes, source, receiver, (), True, identity, now_ns, before)
        else:
            is_broadcast = receiver is None
            frame = Frame(payload, size_bytes, source, relay, (receiver,), is_broadcast, identity, now_ns, before)
        frame.max_attempts = max_attempts
        self._enqueue(now_ns, station, frame)

    def next_event_ns(self) -> int | None:
        """Return the time of the next event for `deliveries`, or None if no packet is in flight."""
        return self._events.next_ns()

    def deliveries(self, now_ns: int) -> list[Delivery[Payload]]:
        """Return the packets that arrived up to `now_ns` and were not returned before, in order of arrival."""
        self.advance(now_ns)
        arrived, self._arrived = self._arrived, []
        return arrived

    def advance(self, now_ns: int) -> None:
        """Run all events up to `now_ns`."""
        self._events.advance(now_ns)

    def _enqueue(self, now_ns: int, station: Station[Payload], frame: Frame[Payload]) -> None:
        queue = station.queue
        peer = None if frame.receiver is None else self._peer(station.index, frame.receiver)
        if peer is not None and not self._channel.linked(station.index, peer.receiver):
            peer.count(delivered=False)
            self._lose(now_ns, station.index, frame, OUT_OF_RANGE)
            return
        if len(queue) > self._queue_packets:
            if peer is not None:
                peer.queue_dropped += 1
            self._lose(now_ns, station.index, frame, QUEUE_FULL)
            return
        queue.append(frame)
        if len(queue) == 1 and not station.exchange_id & 1:
            self._contend(now_ns, station)

    def _contend(self, now_ns: int, station: Station[Payload]) -> None:
        self._events.schedule_start(station.contention.earliest_start_ns(now_ns), station.index)

    def _start_transmission(self, now_ns: int, index: int) -> None:
        station = self._stations[index]
        station.contention.earliest_start_ns(now_ns)
        if self._reception.is_jammed(index):
            self._events.at(now_ns + _JAMMED_RETRY_NS, self._retry_when_idle, station)
            return
        station.exchange_id += 1
        frame = station.queue[0]
        receiver = frame.receiver
        peer = None if receiver is None else self._peer(station.index, receiver)
        if peer is not None and peer.session is not None:
            self._start_aggregate(now_ns, station, peer, peer.session)
            return
        if not frame.attempts:
            frame.first_attempt_ns = now_ns
        frame.attempts += 1
        packet, number = frame.packet, frame.attempts
        mode = self._basic if peer is None else peer.rate.choose(now_ns, packet, number)
        size_bytes = frame.size_bytes + HEADER_BYTES
        end_ns = now_ns + mode.airtime_ns(size_bytes)
        reserved_ns = end_ns if receiver is None else end_ns + self._sifs_ns + ack_ns(mode)
        transmission = Transmission(station.index, now_ns, end_ns, mode, size_bytes, packet, number)
        self._reception.start(transmission, reserved_ns)
        if self._meter is not None:
            self._meter.on_start(transmission, receiver)
        self._events.at(end_ns, self._end_transmission, station, frame, transmission)

    def _start_aggregate(
        self, now_ns: int, station: Station[Payload], peer: Peer[Payload], session: BlockAckSession[Payload]
    ) -> None:
        first = station.queue[0]
        # Hardware repeats an aggregate in the next mode of the chain only if the Block Ack is missing.
        mode = peer.rate.choose(now_ns, first.packet, min(peer.failed_exchanges + 1, SHORT_RETRY_LIMIT))
        aggregate = station.aggregate = session.build_aggregate(station.queue, mode)
        for frame in aggregate.frames:
            if not frame.attempts:
                frame.first_attempt_ns = now_ns
            frame.attempts += 1
        size_bytes, response_bytes = aggregate.size_bytes, aggregate.response_bytes
        end_ns = now_ns + mode.airtime_ns(size_bytes)
        transmission = Transmission(station.index, now_ns, end_ns, mode, size_bytes, first.packet, first.attempts)
        transmission.response_bytes = response_bytes
        self._reception.start(transmission, end_ns + self._sifs_ns + response_ns(mode, response_bytes))
        if self._meter is not None:
            self._meter.on_start(transmission, None)
            self._meter.on_aggregate(transmission, peer.receiver, aggregate.frames)
        self._events.at(end_ns, self._end_aggregate, station, peer, aggregate, transmission)

    def _end_aggregate(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload],
        aggregate: Aggregate[Payload],
        transmission: Transmission,
    ) -> None:
        decoded = aggregate.decoded = self._reception.decoded_frames(peer.receiver, transmission, aggregate)
        self._reception.end(now_ns, transmission)
        if self._log is not None:
            for frame in aggregate.frames:
                received = [peer.receiver] if frame in decoded else []
                size_bytes = frame.size_bytes + QOS_HEADER_BYTES
                self._log(attempt_record(self._channel.names, transmission, frame, received, size_bytes))
        if station.aggregate is not aggregate:
            return  # aborted: its radio was switched off
        assert peer.session is not None
        self._pass_up(now_ns, station.index, peer, peer.session.receive(decoded))
        self._await_ack(now_ns, station, peer.receiver, transmission, is_decoded=bool(decoded))

    def _retry_when_idle(self, now_ns: int, station: Station[Payload]) -> None:
        if not station.queue or station.exchange_id & 1 or station.index in self._events.starts:
            return
        if self._reception.is_jammed(station.index):
            self._events.at(now_ns + _JAMMED_RETRY_NS, self._retry_when_idle, station)
        else:
            station.contention.set_busy_until(now_ns)
            self._contend(now_ns, station)

    def _end_transmission(
        self, now_ns: int, station: Station[Payload], frame: Frame[Payload], transmission: Transmission
    ) -> None:
        receiver = frame.receiver
        addressed = sorted(transmission.receivers) if receiver is None else [receiver]
        received = [index for index in addressed if self._reception.decodes(index, transmission, "data")]
        self._reception.end(now_ns, transmission)
        if self._log is not None:
            self._log(attempt_record(self._channel.names, transmission, frame, received, transmission.size_bytes))
        if not station.queue or station.queue[0] is not frame:
            return  # aborted: its radio was switched off
        for index in received:
            self._receive(now_ns, station.index, index, frame)
        if receiver is None:
            self._broadcast(now_ns, station.index, frame, received)
            self._end_exchange(now_ns, station, done=True)
        else:
            self._await_ack(now_ns, station, receiver, transmission, is_decoded=bool(received))

    def _await_ack(
        self, now_ns: int, station: Station[Payload], receiver: int, transmission: Transmission, *, is_decoded: bool
    ) -> None:
        exchange_id, call_at = station.exchange_id, self._events.at
        if is_decoded:
            ack_ns = now_ns + self._sifs_ns
            call_at(ack_ns, self._acknowledge, self._stations[receiver], station, transmission, exchange_id)
        call_at(now_ns + self._ack_timeout_ns, self._ack_timeout, station, exchange_id, transmission.mode)

    def _broadcast(self, now_ns: int, transmitter: int, frame: Frame[Payload], received: list[int]) -> None:
        for index, name in enumerate(self._channel.names):
            linked, missed = self._channel.linked(transmitter, index), index not in received
            if linked:
                self._peer(transmitter, index).count(delivered=not missed)
            if missed and index != transmitter and self._log_loss is not None and name != frame.source:
                self._log_loss(now_ns, frame.payload, name, NOT_DECODED if linked else OUT_OF_RANGE)

    def _acknowledge(
        self,
        now_ns: int,
        receiver: Station[Payload],
        station: Station[Payload],
        transmission: Transmission,
        exchange_id: int,
    ) -> None:
        if receiver.sending_until_ns > now_ns:
            return
        mode, size_bytes = transmission.mode, transmission.response_bytes
        end_ns = now_ns + response_ns(mode, size_bytes)
        packet, number = transmission.packet, transmission.attempt
        ack = Transmission(receiver.index, now_ns, end_ns, control_mode(mode), size_bytes, packet, number)
        self._reception.start(ack, end_ns)
        if self._meter is not None:
            self._meter.on_start(ack, None)
        ack_exchange_id = 0
        if station.receiving is ack and station.exchange_id == exchange_id:
            ack_exchange_id = station.exchange_id = exchange_id + 2  # so that the ACK timeout is ignored
        self._events.at(end_ns, self._end_ack, station, ack, mode, ack_exchange_id)

    def _end_ack(
        self, now_ns: int, station: Station[Payload], ack: Transmission, mode: WifiMode, exchange_id: int
    ) -> None:
        decoded = station.receiving is ack and self._reception.decodes(station.index, ack, "ack")
        self._reception.end(now_ns, ack)
        if self._log is not None:
            self._log(ack_record(self._channel.names, ack, station.index, decoded=decoded))
        if exchange_id == station.exchange_id:
            self._finish_attempt(now_ns, station, mode, acknowledged=decoded)

    def _ack_timeout(self, now_ns: int, station: Station[Payload], exchange_id: int, mode: WifiMode) -> None:
        if exchange_id == station.exchange_id:
            self._finish_attempt(now_ns, station, mode, acknowledged=False)

    def _finish_attempt(self, now_ns: int, station: Station[Payload], mode: WifiMode, *, acknowledged: bool) -> None:
        frame = station.queue[0]
        assert frame.receiver is not None
        peer = self._peer(station.index, frame.receiver)
        if station.aggregate is not None:
            self._finish_aggregate(now_ns, station, peer, mode, acknowledged=acknowledged)
            return
        peer.rate.report(mode, acknowledged=acknowledged)
        if not acknowledged:
            station.contention.set_busy_until(now_ns)
        done = acknowledged or frame.attempts >= frame.max_attempts
        if done:
            peer.count(delivered=peer.last_frame is frame)
            if self._meter is not None and not acknowledged:
                self._meter.on_failure(station.index, frame.receiver)
            if peer.last_frame is not frame:
                self._lose(now_ns, station.index, frame, RETRIES_EXHAUSTED)
        self._end_exchange(now_ns, station, done=done)

    def _finish_aggregate(
        self, now_ns: int, station: Station[Payload], peer: Peer[Payload], mode: WifiMode, *, acknowledged: bool
    ) -> None:
        aggregate, session = station.aggregate, peer.session
        assert aggregate is not None
        assert session is not None
        station.aggregate = None
        frames, confirmed = aggregate.frames, set(aggregate.decoded if acknowledged else ())
        peer.rate.report(mode, acknowledged=len(confirmed), attempts=len(frames))
        if acknowledged:
            station.contention.on_success()
            peer.failed_exchanges = 0
        else:
            station.contention.set_busy_until(now_ns)
            station.contention.on_failure()
            peer.failed_exchanges += 1
        given_up = {frame for frame in frames if frame not in confirmed and frame.attempts >= frame.max_attempts}
        lost = [frame for frame in frames if frame in given_up and not frame.is_received]
        for frame in lost:
            self._lose(now_ns, station.index, frame, RETRIES_EXHAUSTED)
        peer.count_frames(delivered=len(confirmed) + len(given_up) - len(lost), lost=len(lost))
        if self._meter is not None:
            self._meter.link(station.index, peer.receiver).failures += len(given_up)
        if lost:
            self._pass_up(now_ns, station.index, peer, session.skip(lost))
        remove_frames(station.queue, confirmed | given_up)
        station.exchange_id += 1
        if station.queue:
            self._contend(now_ns, station)

    def _end_exchange(self, now_ns: int, station: Station[Payload], *, done: bool) -> None:
        station.exchange_id += 1
        if done:
            station.contention.on_success()
            station.queue.popleft()
        else:
            station.contention.on_failure()
        if station.queue:
            self._contend(now_ns, station)

    def _receive(self, now_ns: int, transmitter: int, receiver: int, frame: Frame[Payload]) -> None:
        peer = self._peer(transmitter, receiver)
        if peer.last_frame is frame:
            return
        peer.last_frame = frame
        self._pass_up(now_ns, transmitter, peer, (frame,))

    def _pass_up(self, now_ns: int, transmitter: int, peer: Peer[Payload], frames: Iterable[Frame[Payload]]) -> None:
        """Deliver frames at a receiver, or queue them for their second hop."""
        receiver = peer.receiver
        propagation_ns = self._channel.delay_ns(transmitter, receiver)
        for frame in frames:
            delay_so_far = frame.total_delay(now_ns, propagation_ns)
            if frame.keep:
                self._events.at(
                    now_ns + propagation_ns, self._deliver, receiver, frame.payload, frame.source, delay_so_far
                )
            for onward in frame.onward:
                self._enqueue(now_ns, self._stations[receiver], frame.for_second_hop(now_ns, onward, delay_so_far))

    def _deliver(self, now_ns: int, receiver: int, payload: Payload, source: str, delay_so_far: Delay) -> None:
        name = self._channel.names[receiver]
        if name != source:  # an access point also repeats a broadcast to its sender
            self._arrived.append((now_ns, name, payload, source, delay_so_far))

    def _lose(self, now_ns: int, transmitter: int, frame: Frame[Payload], reason: str) -> None:
        """Log that a frame was not delivered beyond `transmitter`, for each station that it would have reached."""
        if self._log_loss is None:
            return
        for name in self._intended_receivers(transmitter, frame):
            self._log_loss(now_ns, frame.payload, name, reason)

    def _intended_receivers(self, transmitter: int, frame: Frame[Payload]) -> Iterable[str]:
        names = self._channel.names
        ends = frame.onward or (frame.receiver,)
        if ends == (None,):
            return [name for name in names if name not in {frame.source, names[transmitter]}]
        return [names[index] for index in ends if index is not None]

    def _peer(self, transmitter: int, receiver: int) -> Peer[Payload]:
        pair = transmitter, receiver
        if pair not in self._peers:
            limits = self._channel.ampdu_limits(*pair)
            session: BlockAckSession[Payload] | None = None if limits is None else BlockAckSession(limits)
            self._peers[pair] = Peer(receiver, self._channel.rate_control(*pair), session)
        return self._peers[pair]
