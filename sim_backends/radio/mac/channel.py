"""The interface of a radio channel, which gives the received power of each station at all others; and jammers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from fieldkit.config.wifi_phy import DscpMapping
from fieldkit.core.model import Vector
from sim_backends.radio.mac.aggregation import AmpduLimits
from sim_backends.radio.phy.modes import BAND_2_4, Band
from sim_backends.radio.rate_control.rate_control import RateControl


class RadioChannel(Protocol):
    """The received power of each station at each other station.

    Attributes:
        names: Names of the stations; the methods identify stations by their index in this list.
        noise_mw: Noise power at each station, in mW.
        sensitivity_mw: Received power of the weakest frame that each station detects, in mW. A station does not send
            while it detects a frame.
        band: Band in which all stations send.
    """

    band: Band = BAND_2_4
    names: Sequence[str]
    noise_mw: Sequence[float]
    sensitivity_mw: Sequence[float]

    def powers_mw(self, transmitter: int, now_ns: int) -> list[float]:
        """Return the received power of `transmitter` at each station at `now_ns`, in mW; 0 at the transmitter.

        A returned list is never modified. If the same list object is returned again, the powers have not changed.
        """
        ...

    def are_linked(self, transmitter: int, receiver: int) -> bool:
        """Return True if both stations can receive each other; a frame to one station is sent only in this case."""
        ...

    def delay_ns(self, transmitter: int, receiver: int) -> int:
        """Return the propagation delay, in ns."""
        ...

    def ifs_ns(self, station: int) -> int:  # noqa: ARG002 (a default)
        """Return the inter-frame space of a station before its backoff: DIFS, or the AIFS of a station with QoS."""
        return self.band.difs_ns

    def rts_threshold_bytes(self, station: int) -> int | None:  # noqa: ARG002 (a default)
        """Return the largest size of a frame or aggregate that a station sends without RTS; None for any size."""
        return None

    def dscp_mapping(self, station: int) -> DscpMapping | None:  # noqa: ARG002 (a default)
        """Return the mapping of packets to a station's access categories; None if it has only one queue."""
        return None

    def power_save_timeout_ns(self, station: int) -> int | None:  # noqa: ARG002 (a default)
        """Return the time from a station's last frame until it dozes; None if it never dozes."""
        return None

    def packet_time_ns(self, station: int) -> int:  # noqa: ARG002 (a default)
        """Return the time that the bus and driver of a station need per packet, before the queue of its radio."""
        return 0

    def ampdu_limits(self, transmitter: int, receiver: int) -> AmpduLimits | None:  # noqa: ARG002 (a default)
        """Return the limits of aggregates on a link; None if its frames are not aggregated."""
        return None

    def rate_control(self, transmitter: int, receiver: int) -> RateControl:
        """Return the rate control of a link; called once per link."""
        ...


@dataclass(frozen=True, slots=True)
class Emitter:
    """A transmitter of noise in the whole channel.

    Attributes:
        name: Its name, which does not change while it sends without a pause.
        position_m: Current position, metres east, north, up.
        power_dbm: Transmit power.
    """

    name: str
    position_m: Vector
    power_dbm: float
