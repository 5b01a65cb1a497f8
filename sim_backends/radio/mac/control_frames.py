"""The common part of exchanges of control frames: RTS and CTS before data frames, ACK and Block Ack after them."""

from collections.abc import Callable, Sequence
from typing import Generic

from sim_backends.radio.core.links import Payload
from sim_backends.radio.mac.contention import EventQueue
from sim_backends.radio.mac.driver_statistics import RadioMeter
from sim_backends.radio.mac.frames import ControlFrame, TransmissionAttempt, control_record
from sim_backends.radio.mac.reception import Reception
from sim_backends.radio.mac.stations import Station
from sim_backends.radio.phy.modes import Band
from sim_backends.radio.phy.transmissions import Transmission


class ControlFrames(Generic[Payload]):
    """Control frames of stations that share one channel.

    Args:
        names: Names of the stations.
        band: Their band.
        stations: Stations by index.
        events: Scheduled events.
        reception: The frames on the air.

    Attributes:
        log: Called with every control frame that ends; None without a log.
        meter: Counters of the radio drivers; None without counters.
    """

    def __init__(
        self,
        names: Sequence[str],
        band: Band,
        stations: Sequence[Station[Payload]],
        events: EventQueue,
        reception: Reception[Payload],
    ) -> None:
        self._names = names
        self._sifs_ns = band.sifs_ns
        self._stations = stations
        self._events = events
        self._reception = reception
        self.log: Callable[[TransmissionAttempt], None] | None = None
        self.meter: RadioMeter | None = None

    def _count(self, transmission: Transmission) -> None:
        """Count a control frame that starts."""
        if self.meter is not None:
            self.meter.on_start(transmission, None)

    def _log(self, transmission: Transmission, receiver: int, kind: ControlFrame, *, is_decoded: bool) -> None:
        """Log a control frame that ends."""
        if self.log is not None:
            self.log(control_record(self._names, transmission, receiver, kind, is_decoded=is_decoded))
