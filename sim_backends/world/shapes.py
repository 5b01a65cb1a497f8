"""Solid shapes that straight paths may cross; all paths and shapes are processed together."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.model import Vector

Floats = NDArray[np.float64]
"""An array of numbers; positions are in metres east, north, up."""

_CIRCLE_CORNERS: Final = 32
"""Number of corners of the polygon that is drawn for a circle."""


@dataclass(frozen=True)
class Box:
    """An upright box, rotated about the vertical.

    Attributes:
        centre_m: Its centre.
        size_m: Its edges along its axes, in metres.
        yaw_rad: Rotation of its first axis from east towards north.
    """

    centre_m: Vector
    size_m: Vector
    yaw_rad: float = 0.0

    @property
    def top_m(self) -> float:
        """Height of its upper face."""
        return self.centre_m[2] + self.size_m[2] / 2

    def corners_m(self) -> tuple[tuple[float, float], ...]:
        """Return its outline from above, metres east and north."""
        along, across = self.size_m[0] / 2, self.size_m[1] / 2
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return tuple(
            (self.centre_m[0] + x * cos - y * sin, self.centre_m[1] + x * sin + y * cos)
            for x, y in ((along, across), (-along, across), (-along, -across), (along, -across))
        )


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder.

    Attributes:
        centre_m: Its centre.
        radius_m: Its radius.
        height_m: Its height.
    """

    centre_m: Vector
    radius_m: float
    height_m: float

    @property
    def top_m(self) -> float:
        """Height of its upper face."""
        return self.centre_m[2] + self.height_m / 2

    def corners_m(self) -> tuple[tuple[float, float], ...]:
        """Return its outline from above, metres east and north, as a polygon."""
        turns = (2 * math.pi * number / _CIRCLE_CORNERS for number in range(_CIRCLE_CORNERS))
        return tuple(
            (self.centre_m[0] + self.radius_m * math.cos(turn), self.centre_m[1] + self.radius_m * math.sin(turn))
            for turn in turns
        )


Shape = Box | Cylinder
