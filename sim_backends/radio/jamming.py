"""Jammers as a radio model is told of them."""

from dataclasses import dataclass

from fieldkit.core.model import Vector


@dataclass(frozen=True, slots=True)
class Emitter:
    """Who sends noise in the whole channel now.

    Attributes:
        name: Which, the same as long as it sends without a pause.
        place_m: Where it is now, metres east, north, up.
        power_dbm: Power that it sends with.
    """

    name: str
    place_m: Vector
    power_dbm: float
