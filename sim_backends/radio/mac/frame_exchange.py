"""Exchanges of frames and their acknowledgements: single frames with ACK, broadcasts, and A-MPDU with Block Ack."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, Generic

from sim_backends.radio.core.links import RETRIES_EXHAUSTED, Payload
from sim_backends.radio.core.random_streams import PacketDraws
from sim_backends.radio.mac.acknowledgements import Acknowledgements
from sim_backends.radio.mac.aggregation import (
    MAX_PPDU_NS,
    QOS_HEADER_BYTES,
    Aggregate,
    BlockAckSession,
    remove_frames,
)
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.mac.driver_statistics import RadioMeter
from sim_backends.radio.mac.frames import HEADER_BYTES, Frame, TransmissionAttempt, attempt_record
from sim_backends.radio.mac.packet_delivery import PacketDelivery
from sim_backends.radio.mac.reception import Reception
from sim_backends.radio.mac.rts_cts import ProtectedFrame, RtsCts, rts_threshold_bytes
from sim_backends.radio.mac.stations import Peer, Station
from sim_backends.radio.phy.modes import SHORT_RETRY_LIMIT, WifiMode, ack_ns, basic_mode, response_ns
from sim_backends.radio.phy.transmissions import Transmission

# Retry interval of a station that finds the channel jammed; a robot hardly moves in this time.
_JAMMED_RETRY_NS: Final = 1_000_000


class FrameExchange(Generic[Payload]):
    """The frame exchanges of stations that share one channel.

    An exchange starts after a backoff or in a transmission opportunity. It ends with the response or its timeout, or,
    for a broadcast, with the frame. Then the next exchange of the station is scheduled.

    Args:
        channel: Received powers between the stations.
        seed: Seed of all random draws.
        queue_packets: Maximum number of packets in each queue of a station, without the first packet.
        make_delivery: Class of `delivery`.

    Attributes:
        stations: Stations by index.
        events: Scheduled events.
        delivery: Queues of the stations, and delivered packets.
        reception: The frames on the air.
        rts_cts: RTS and CTS before the frames of stations with a threshold.
        acknowledgements: ACKs and Block Acks after frames.
        log: Called at the end of each attempt to send a data frame; None without a log.
        meter: Counters of the radio drivers; None without counters.
    """

    def __init__(
        self,
        channel: RadioChannel,
        seed: int,
        queue_packets: int,
        make_delivery: type[PacketDelivery[Payload]] = PacketDelivery,
    ) -> None:
        self._names = channel.names
        band = channel.band
        self._basic = basic_mode(band)
        self._sifs_ns = band.sifs_ns
        self.stations: list[Station[Payload]] = [
            Station(
                index, PacketDraws(seed, name, "backoff"), channel.ifs_ns(index), rts_threshold_bytes(channel, index)
            )
            for index, name in enumerate(channel.names)
        ]
        for station in self.stations:
            mapping = channel.dscp_mapping(station.index)
            if mapping is not None:
                station.use_categories(mapping, band)
        self.events = EventQueue(self._start)
        self.delivery: PacketDelivery[Payload] = make_delivery(channel, self.stations, self.events, queue_packets)
        self.reception = Reception(channel, seed, self.stations, self.events)
        self.rts_cts = RtsCts(self._names, band, self.stations, self.events, self.reception)
        self.acknowledgements = Acknowledgements(
            self._names, band, self.stations, self.events, self.reception, finish=self._finish_attempt
        )
        self.log: Callable[[TransmissionAttempt], None] | None = None
        self.meter: RadioMeter | None = None

    def abort(self, now_ns: int, station: Station[Payload]) -> None:
        """End the exchange of a station whose radio is switched off, and cancel its next one."""
        self.reception.abort(station.index, now_ns)
        self.events.cancel_start(station.index)
        if station.is_in_exchange:
            station.exchange_id += 1
        station.aggregate = None

    def retry_when_idle(self, now_ns: int, station: Station[Payload]) -> None:
        """Schedule the next exchange of a station that may have waited for the end of jammer noise."""
        if not station.has_frames or station.is_in_exchange or station.index in self.events.starts:
            return
        if self.reception.is_jammed(station.index):
            self.events.schedule(now_ns + _JAMMED_RETRY_NS, self.retry_when_idle, station)
        else:
            station.contention.set_busy_until(now_ns)
            self._contend(now_ns, station)

    def _contend(self, now_ns: int, station: Station[Payload]) -> None:
        """Schedule the next exchange of a station after contention."""
        self.events.schedule_start(station.contention.earliest_start_ns(now_ns), station.index)

    def _start(self, now_ns: int, index: int) -> None:
        """Start an exchange of a station after its backoff, or in its transmission opportunity."""
        station = self.stations[index]
        station.contention.earliest_start_ns(now_ns)  # counts down the backoff slots that were idle until now
        if self.reception.is_jammed(index):
            self.events.schedule(now_ns + _JAMMED_RETRY_NS, self.retry_when_idle, station)
            return
        if station.categories is not None:
            station.queue = station.categories.select(now_ns)
        station.exchange_id += 1
        frame = station.queue[0]
        peer = None if frame.receiver is None else self.delivery.peer(index, frame.receiver, frame.category)
        if peer is not None and peer.session is not None:
            self._start_aggregate(now_ns, station, peer, peer.session)
        else:
            self._start_frame(now_ns, station, peer, frame)

    def _start_frame(
        self, now_ns: int, station: Station[Payload], peer: Peer[Payload] | None, frame: Frame[Payload]
    ) -> None:
        """Start an attempt to send a single frame, after RTS and CTS if it is large."""
        if not frame.attempts:
            frame.first_attempt_ns = now_ns
        frame.attempts += 1
        if peer is None:
            mode = self._basic
        else:
            mode = peer.mode = peer.rate.choose(now_ns, frame.packet, frame.attempts)
            size_bytes = frame.size_bytes + HEADER_BYTES
            if size_bytes > station.rts_threshold_bytes:
                exchange_ns = mode.airtime_ns(size_bytes) + self._sifs_ns + ack_ns(mode)
                send = partial(self._send_frame, station=station, peer=peer, frame=frame, mode=mode)
                self._protect(now_ns, station, peer, [frame], exchange_ns=exchange_ns, send=send)
                return
        self._send_frame(now_ns, station, peer, frame, mode)

    def _send_frame(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload] | None,
        frame: Frame[Payload],
        mode: WifiMode,
    ) -> None:
        """Transmit a single frame."""
        size_bytes = frame.size_bytes + HEADER_BYTES
        end_ns = now_ns + mode.airtime_ns(size_bytes)
        reserved_ns = end_ns if peer is None else end_ns + self._sifs_ns + ack_ns(mode)
        transmission = Transmission(station.index, now_ns, end_ns, mode, size_bytes, frame.packet, frame.attempts)
        self.reception.start(transmission, reserved_ns)
        if self.meter is not None:
            self.meter.on_start(transmission, frame.receiver)
        self.events.schedule(end_ns, self._end_frame, station, peer, frame, transmission)

    def _end_frame(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload] | None,
        frame: Frame[Payload],
        transmission: Transmission,
    ) -> None:
        """Determine which stations decode a frame that ends now, and wait for the ACK if it has one receiver."""
        receivers = sorted(transmission.receivers) if peer is None else [peer.receiver]
        received = [index for index in receivers if self.reception.decodes(index, transmission, "data")]
        is_aborted = not station.queue or station.queue[0] is not frame
        is_answered = bool(received) and peer is not None and not is_aborted
        self.reception.end(now_ns, transmission, is_answered=is_answered)
        if self.log is not None:
            self.log(attempt_record(self._names, transmission, frame, received, transmission.size_bytes))
        if is_aborted:
            return  # its radio was switched off
        if peer is None:
            self._end_broadcast(now_ns, station, frame, received)
            return
        if received:
            self._receive(now_ns, station, peer, frame)
        self.acknowledgements.start(now_ns, station, peer, transmission, is_decoded=bool(received))

    def _end_broadcast(
        self, now_ns: int, station: Station[Payload], frame: Frame[Payload], received: list[int]
    ) -> None:
        for index in received:
            self._receive(now_ns, station, self.delivery.peer(station.index, index), frame)
        self.delivery.count_broadcast(now_ns, station.index, frame, received)
        self._end_exchange(now_ns, station, None, is_done=True)

    def _receive(self, now_ns: int, station: Station[Payload], peer: Peer[Payload], frame: Frame[Payload]) -> None:
        if peer.last_frame is not frame:
            peer.last_frame = frame
            self.delivery.pass_up(now_ns, station.index, peer, (frame,))

    def _start_aggregate(
        self, now_ns: int, station: Station[Payload], peer: Peer[Payload], session: BlockAckSession[Payload]
    ) -> None:
        """Build an aggregate, and start an attempt to send it, after RTS and CTS if it is large."""
        first = station.queue[0]
        # Hardware repeats an aggregate in the next mode of the retry chain only if the Block Ack is missing.
        mode = peer.mode = peer.rate.choose(now_ns, first.packet, min(peer.failed_exchanges + 1, SHORT_RETRY_LIMIT))
        limit_ns = MAX_PPDU_NS
        if station.categories is not None:
            answer_ns = self._sifs_ns + response_ns(mode, session.block_ack_bytes)
            limit_ns = min(station.categories.remaining_ns(now_ns) - answer_ns, MAX_PPDU_NS)
        aggregate = station.aggregate = session.build_aggregate(
            station.queue, mode, is_single=peer.rate.is_probing, limit_ns=limit_ns
        )
        for frame in aggregate.frames:
            if not frame.attempts:
                frame.first_attempt_ns = now_ns
            frame.attempts += 1
        size_bytes = aggregate.size_bytes
        if size_bytes > station.rts_threshold_bytes:
            exchange_ns = mode.airtime_ns(size_bytes) + self._sifs_ns + response_ns(mode, aggregate.response_bytes)
            send = partial(self._send_aggregate, station=station, peer=peer, aggregate=aggregate)
            self._protect(now_ns, station, peer, aggregate.frames, exchange_ns=exchange_ns, send=send)
            return
        self._send_aggregate(now_ns, station, peer, aggregate)

    def _protect(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload],
        frames: Sequence[Frame[Payload]],
        *,
        exchange_ns: int,
        send: Callable[[int], None],
    ) -> None:
        """Send RTS before a frame or an aggregate, and call `send` after the CTS to send the data."""

        def fail(at_ns: int) -> None:
            if self.meter is not None:
                self.meter.on_failed_rts(station.index, peer.receiver, frames)
            self._finish_attempt(at_ns, station, peer, acknowledged=False, is_sent=False)

        first = frames[0]
        frame = ProtectedFrame(
            station, peer.receiver, peer.mode, exchange_ns, first.packet, first.attempts, send, fail
        )
        self.rts_cts.start(now_ns, frame)

    def _send_aggregate(
        self, now_ns: int, station: Station[Payload], peer: Peer[Payload], aggregate: Aggregate[Payload]
    ) -> None:
        """Transmit an aggregate."""
        mode, first = peer.mode, aggregate.frames[0]
        size_bytes, response_bytes = aggregate.size_bytes, aggregate.response_bytes
        end_ns = now_ns + mode.airtime_ns(size_bytes)
        transmission = Transmission(station.index, now_ns, end_ns, mode, size_bytes, first.packet, first.attempts)
        transmission.response_bytes, transmission.frame_count = response_bytes, aggregate.frame_count
        self.reception.start(transmission, end_ns + self._sifs_ns + response_ns(mode, response_bytes))
        if self.meter is not None:
            self.meter.on_start(transmission, None)
            self.meter.on_aggregate(transmission, peer.receiver, aggregate.frames)
        self.events.schedule(end_ns, self._end_aggregate, station, peer, aggregate, transmission)

    def _end_aggregate(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload],
        aggregate: Aggregate[Payload],
        transmission: Transmission,
    ) -> None:
        """Determine which frames of an aggregate that ends now are decoded, and wait for the Block Ack."""
        decoded_frames = aggregate.decoded_frames = self.reception.decode_frames(
            peer.receiver, transmission, aggregate
        )
        self.reception.end(now_ns, transmission, is_answered=bool(decoded_frames) and station.aggregate is aggregate)
        if self.log is not None:
            for frame in aggregate.frames:
                received = [peer.receiver] if frame in decoded_frames else []
                size_bytes = frame.size_bytes + QOS_HEADER_BYTES
                self.log(attempt_record(self._names, transmission, frame, received, size_bytes))
        if station.aggregate is not aggregate:
            return  # aborted: its radio was switched off
        assert peer.session is not None
        self.delivery.pass_up(now_ns, station.index, peer, peer.session.receive(decoded_frames))
        self.acknowledgements.start(now_ns, station, peer, transmission, is_decoded=bool(decoded_frames))

    def _finish_attempt(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload],
        *,
        acknowledged: bool,
        is_sent: bool = True,
    ) -> None:
        """End an attempt. If no CTS arrived, `is_sent` is False, and the result is not used for rate control."""
        if not acknowledged:
            if station.categories is None:
                station.contention.set_busy_until(now_ns)
            else:
                station.categories.wait_until(now_ns)
        if peer.session is not None:
            self._finish_aggregate(now_ns, station, peer, peer.session, acknowledged=acknowledged, is_sent=is_sent)
            return
        frame = station.queue[0]
        if is_sent:
            peer.rate.report(peer.mode, acknowledged=acknowledged)
        is_done = acknowledged or frame.attempts >= frame.max_attempts
        if is_done:
            is_received = peer.last_frame is frame
            peer.count(delivered=is_received)
            if self.meter is not None and not acknowledged:
                self.meter.on_failures(station.index, peer.receiver, 1)
            if not is_received:
                self.delivery.lose(now_ns, station.index, frame, RETRIES_EXHAUSTED)
        self._end_exchange(now_ns, station, peer, is_done=is_done)

    def _end_exchange(
        self, now_ns: int, station: Station[Payload], peer: Peer[Payload] | None, *, is_done: bool
    ) -> None:
        """End the exchange of a single frame, and schedule the next exchange of the station."""
        station.exchange_id += 1
        if is_done:
            station.contention.on_success()
            station.queue.popleft()
        else:
            station.contention.on_failure()
        self._start_next(now_ns, station, peer)

    def _finish_aggregate(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload],
        session: BlockAckSession[Payload],
        *,
        acknowledged: bool,
        is_sent: bool,
    ) -> None:
        """End an attempt to send an aggregate: count the results, and remove finished frames from the queue."""
        aggregate = station.aggregate
        assert aggregate is not None
        station.aggregate = None
        frames, acknowledged_frames = aggregate.frames, set(aggregate.decoded_frames if acknowledged else ())
        if is_sent:
            count = aggregate.frame_count
            acknowledged_count = len(acknowledged_frames)
            if count < len(frames):
                acknowledged_count = len({packet.sequence for packet in acknowledged_frames})
            peer.rate.report(peer.mode, acknowledged=acknowledged_count, frames=count)
        if acknowledged:
            station.contention.on_success()
            peer.failed_exchanges = 0
        else:
            station.contention.on_failure()
            peer.failed_exchanges += is_sent
        failed_frames = {
            frame for frame in frames if frame not in acknowledged_frames and frame.attempts >= frame.max_attempts
        }
        lost_frames = [frame for frame in frames if frame in failed_frames and not frame.is_received]
        for frame in lost_frames:
            self.delivery.lose(now_ns, station.index, frame, RETRIES_EXHAUSTED)
        delivered = len(acknowledged_frames) + len(failed_frames) - len(lost_frames)
        peer.count_frames(delivered=delivered, lost=len(lost_frames))
        if self.meter is not None:
            self.meter.on_failures(station.index, peer.receiver, len(failed_frames))
        if lost_frames:
            self.delivery.pass_up(now_ns, station.index, peer, session.skip(lost_frames))
        remove_frames(station.queue, acknowledged_frames | failed_frames)
        station.exchange_id += 1
        self._start_next(now_ns, station, peer)

    def _start_next(self, now_ns: int, station: Station[Payload], peer: Peer[Payload] | None) -> None:
        """Schedule the next exchange of a station: in its transmission opportunity, or after contention."""
        categories = station.categories
        if (
            categories is not None
            and peer is not None
            and station.queue
            and (frame := station.queue[0]).receiver == peer.receiver
        ):
            session = peer.session
            size_bytes = frame.size_bytes + QOS_HEADER_BYTES
            if session is not None:
                size_bytes = session.first_frame_bytes(station.queue)
            data_ns = peer.mode.airtime_ns(size_bytes)
            start_ns = categories.continue_ns(now_ns, data_ns + self._sifs_ns + ack_ns(peer.mode))
            if start_ns is not None:
                self.events.schedule_start(start_ns, station.index)
                return
        if station.has_frames:
            self._contend(now_ns, station)
