"""ACK and Block Ack after a data frame or an aggregate, and their timeout (IEEE 802.11-2020, 10.3.2.11)."""

from collections.abc import Sequence
from typing import Final, Protocol

from sim_backends.radio.core.links import Payload
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.mac.control_frames import ControlFrames
from sim_backends.radio.mac.reception import Reception
from sim_backends.radio.mac.stations import Peer, Station
from sim_backends.radio.phy.modes import SLOT_NS, Band, control_mode, response_ns
from sim_backends.radio.phy.transmissions import Transmission

# ACK timeout after SIFS: one slot and aRxPHYStartDelay, which is 20 us in table 17-21.
_TIMEOUT_AFTER_SIFS_NS: Final = SLOT_NS + 20_000


class FinishAttempt(Protocol[Payload]):
    """Called at the end of an attempt to send a frame or an aggregate."""

    def __call__(self, now_ns: int, station: Station[Payload], peer: Peer[Payload], *, acknowledged: bool) -> None:
        """End the attempt of a station at a frame for a peer."""


class Acknowledgements(ControlFrames[Payload]):
    """The ACKs and Block Acks of stations that share one channel.

    Args:
        names: Names of the stations.
        band: Their band.
        stations: Stations by index.
        events: Scheduled events.
        reception: The frames on the air.
        finish: Called when a response was received, or at its timeout.
    """

    def __init__(
        self,
        names: Sequence[str],
        band: Band,
        stations: Sequence[Station[Payload]],
        events: EventQueue,
        reception: Reception[Payload],
        *,
        finish: FinishAttempt[Payload],
    ) -> None:
        super().__init__(names, band, stations, events, reception)
        self._timeout_ns = band.sifs_ns + _TIMEOUT_AFTER_SIFS_NS
        self._finish = finish

    def start(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload],
        transmission: Transmission,
        *,
        is_decoded: bool,
    ) -> None:
        """Start the wait of a station for the response to a transmission that ends now.

        The receiver responds if it has decoded the transmission, or a frame of the aggregate.
        """
        exchange_id = station.exchange_id
        if is_decoded:
            self._events.schedule(now_ns + self._sifs_ns, self._respond, station, peer, transmission, exchange_id)
        self._events.schedule(now_ns + self._timeout_ns, self._time_out, station, peer, exchange_id)

    def _respond(
        self,
        now_ns: int,
        station: Station[Payload],
        peer: Peer[Payload],
        transmission: Transmission,
        exchange_id: int,
    ) -> None:
        """Start the ACK or Block Ack to a transmission of `station`, unless the receiver is transmitting itself."""
        receiver = self._stations[peer.receiver]
        if receiver.sending_until_ns > now_ns:
            self._reception.start_response(transmission, None)
            return
        mode, size_bytes = transmission.mode, transmission.response_bytes
        end_ns = now_ns + response_ns(mode, size_bytes)
        packet, number = transmission.packet, transmission.attempt
        ack = Transmission(receiver.index, now_ns, end_ns, control_mode(mode), size_bytes, packet, number)
        self._reception.start_response(transmission, ack)
        self._count(ack)
        ack_exchange_id = 0
        if station.receiving is ack and station.exchange_id == exchange_id:
            ack_exchange_id = station.exchange_id = exchange_id + 2  # so that the timeout is ignored
        self._events.schedule(end_ns, self._end_response, station, peer, ack, ack_exchange_id)

    def _end_response(
        self, now_ns: int, station: Station[Payload], peer: Peer[Payload], ack: Transmission, exchange_id: int
    ) -> None:
        is_decoded = station.receiving is ack and self._reception.decodes(station.index, ack, "ack")
        self._reception.end(now_ns, ack)
        self._log(ack, station.index, "ACK", is_decoded=is_decoded)
        if exchange_id == station.exchange_id:
            self._finish(now_ns, station, peer, acknowledged=is_decoded)

    def _time_out(self, now_ns: int, station: Station[Payload], peer: Peer[Payload], exchange_id: int) -> None:
        if exchange_id == station.exchange_id:
            self._finish(now_ns, station, peer, acknowledged=False)
