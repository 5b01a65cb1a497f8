"""RTS and CTS before data frames (IEEE 802.11-2020, 10.3.2.4 to 10.3.2.9)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic

from sim_backends.radio.core.links import Payload
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.mac.channel import RadioChannel
from sim_backends.radio.mac.control_frames import ControlFrames
from sim_backends.radio.mac.stations import Station
from sim_backends.radio.phy.modes import SLOT_NS, WifiMode, control_mode
from sim_backends.radio.phy.transmissions import Transmission

_NO_RTS_BYTES: Final = 1 << 62
"""Threshold of a station that never sends RTS."""

RTS_BYTES: Final = 20
CTS_BYTES: Final = 14
_PHY_START_DELAY_NS: Final = 20_000
"""aRxPHYStartDelay of table 17-21."""


def rts_threshold_bytes(channel: RadioChannel, station: int) -> int:
    """Return the size of the largest frame or aggregate that a station sends without RTS."""
    threshold_bytes = channel.rts_threshold_bytes(station)
    return _NO_RTS_BYTES if threshold_bytes is None else threshold_bytes


@dataclass(frozen=True, slots=True)
class ProtectedFrame(Generic[Payload]):
    """A data frame or aggregate that follows RTS and CTS.

    Attributes:
        station: Its sender.
        receiver: Index of its receiver.
        mode: Its mode.
        exchange_ns: Time from its start to the end of its response.
        packet: Its first packet.
        attempt: Number of the attempt for that packet.
        send: Called at its start.
        fail: Called if the sender has not decoded a CTS.
    """

    station: Station[Payload]
    receiver: int
    mode: WifiMode
    exchange_ns: int
    packet: PacketIdentity
    attempt: int
    send: Callable[[int], None]
    fail: Callable[[int], None]


class RtsCts(ControlFrames[Payload]):
    """Exchanges of RTS and CTS of stations that share one channel."""

    def start(self, now_ns: int, frame: ProtectedFrame[Payload]) -> None:
        """Send RTS, at the start of the station's exchange.

        Stations that decode the RTS wait for the CTS. They stop waiting if no data frame follows (10.3.2.4). The CTS
        reserves the channel until the end of the response to the data, at stations that decode it.
        """
        mode = control_mode(frame.mode)
        end_ns = now_ns + mode.airtime_ns(RTS_BYTES)
        # A receiver does not answer while another exchange reserves the channel: 10.3.2.9.
        is_idle = self._stations[frame.receiver].contention.busy_until_ns <= now_ns
        rts = Transmission(frame.station.index, now_ns, end_ns, mode, RTS_BYTES, frame.packet, frame.attempt)
        self._reception.start(rts, end_ns)
        self._count(rts)
        self._events.schedule(end_ns, self._end_rts, frame, rts, is_idle, frame.station.exchange_id)

    def _end_rts(
        self, now_ns: int, frame: ProtectedFrame[Payload], rts: Transmission, is_idle: bool, exchange_id: int
    ) -> None:
        is_decoded = self._reception.decodes(frame.receiver, rts, "rts")
        cts_ns = rts.mode.airtime_ns(CTS_BYTES)
        # NAVTimeout of 10.3.2.4.
        timeout_ns = 2 * (self._sifs_ns + SLOT_NS) + cts_ns + _PHY_START_DELAY_NS
        self._reception.end(now_ns, rts, reserved_ns=now_ns + timeout_ns)
        self._log(rts, frame.receiver, "RTS", is_decoded=is_decoded)
        if exchange_id != frame.station.exchange_id:
            return  # aborted: its radio was switched off
        if is_decoded and is_idle:
            self._events.schedule(now_ns + self._sifs_ns, self._answer, frame, exchange_id)
        timeout_ns = self._sifs_ns + SLOT_NS + _PHY_START_DELAY_NS
        self._events.schedule(now_ns + timeout_ns, self._finish, frame, exchange_id, False)

    def _answer(self, now_ns: int, frame: ProtectedFrame[Payload], exchange_id: int) -> None:
        receiver, station = self._stations[frame.receiver], frame.station
        if receiver.sending_until_ns > now_ns:
            return
        mode = control_mode(frame.mode)
        end_ns = now_ns + mode.airtime_ns(CTS_BYTES)
        cts = Transmission(receiver.index, now_ns, end_ns, mode, CTS_BYTES, frame.packet, frame.attempt)
        self._reception.start(cts, end_ns)
        self._count(cts)
        cts_exchange_id = 0
        if station.receiving is cts and station.exchange_id == exchange_id:
            cts_exchange_id = station.exchange_id = exchange_id + 2  # so that the timeout is ignored
        self._events.schedule(end_ns, self._end_cts, frame, cts, cts_exchange_id)

    def _end_cts(self, now_ns: int, frame: ProtectedFrame[Payload], cts: Transmission, exchange_id: int) -> None:
        station = frame.station
        is_decoded = station.receiving is cts and self._reception.decodes(station.index, cts, "cts")
        self._reception.end(now_ns, cts, reserved_ns=now_ns + self._sifs_ns + frame.exchange_ns)
        self._log(cts, station.index, "CTS", is_decoded=is_decoded)
        self._events.schedule(now_ns + self._sifs_ns, self._finish, frame, exchange_id, is_decoded)

    def _finish(self, now_ns: int, frame: ProtectedFrame[Payload], exchange_id: int, is_protected: bool) -> None:
        if exchange_id != frame.station.exchange_id:
            return
        if is_protected:
            frame.send(now_ns)
        else:
            frame.fail(now_ns)
