"""Jammers, as a radio model receives them."""

from dataclasses import dataclass

from fieldkit.core.model import Vector


@dataclass(frozen=True, slots=True)
class Emitter:
    """A transmitter of noise in the whole channel.

    Attributes:
        name: Name that stays the same while it sends without a pause.
        place_m: Current position, metres east, north, up.
        power_dbm: Transmit power.
    """

    name: str
    place_m: Vector
    power_dbm: float
