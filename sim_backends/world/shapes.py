"""Solid shapes that a straight path may cross, all paths against all shapes at once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Point = tuple[float, float, float]
"""Metres east, north, up."""

_CIRCLE_CORNERS: Final = 32


@dataclass(frozen=True)
class Box:
    """An upright box, turned about the vertical.

    Attributes:
        centre_m: Its centre.
        size_m: Its edges along its own axes, in metres.
        yaw_rad: How far its first axis is turned from east towards north.
    """

    centre_m: Point
    size_m: Point
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

    centre_m: Point
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


def depths_m(shapes: Sequence[Shape], start_m: Floats, end_m: Floats) -> Floats:
    """Return how much of each straight path lies inside each shape.

    Args:
        shapes: m shapes.
        start_m: Where the paths begin, shape (n, 3).
        end_m: Where they end, shape (n, 3).

    Returns:
        Lengths in metres, shape (n, m); 0 where a path misses or only touches.
    """
    length_m = np.linalg.norm(end_m - start_m, axis=1)
    columns = [_inside(shape, start_m, end_m) * length_m for shape in shapes]
    return np.stack(columns, axis=1) if columns else np.zeros((len(start_m), 0))


def _inside(shape: Shape, start_m: Floats, end_m: Floats) -> Floats:
    """Return the share of each path that is inside."""
    start, end = start_m - shape.centre_m, end_m - shape.centre_m
    if isinstance(shape, Cylinder):
        first, last = _disc(start[:, :2], end[:, :2], shape.radius_m)
        below, above = _slab(start[:, 2], end[:, 2], shape.height_m / 2)
        first, last = np.maximum(first, below), np.minimum(last, above)
    else:
        cos, sin = np.cos(shape.yaw_rad), np.sin(shape.yaw_rad)
        turn = np.array(((cos, sin, 0.0), (-sin, cos, 0.0), (0.0, 0.0, 1.0)))
        start, end = start @ turn.T, end @ turn.T
        first, last = np.zeros(len(start)), np.ones(len(start))
        for axis in range(3):
            enters, leaves = _slab(start[:, axis], end[:, axis], shape.size_m[axis] / 2)
            first, last = np.maximum(first, enters), np.minimum(last, leaves)
    inside: Floats = np.maximum(last - first, 0.0)
    return inside


def _slab(start: Floats, end: Floats, half: float) -> tuple[Floats, Floats]:
    """Return where along each path it enters and leaves -half..half, within 0..1; 1 and 0 for one that never does."""
    step = end - start
    level = step == 0
    step = np.where(level, 1.0, step)
    with np.errstate(over="ignore"):  # a path that hardly rises meets the planes infinitely far away
        one, other = (-half - start) / step, (half - start) / step
    enters, leaves = np.clip(np.minimum(one, other), 0, 1), np.clip(np.maximum(one, other), 0, 1)
    within = np.abs(start) < half
    return np.where(level, np.where(within, 0.0, 1.0), enters), np.where(level, np.where(within, 1.0, 0.0), leaves)


def _disc(start: Floats, end: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return the same for a disc around the origin, paths of shape (n, 2)."""
    step = end - start
    a = np.einsum("ij,ij->i", step, step)
    half_b = np.einsum("ij,ij->i", start, step)
    c = np.einsum("ij,ij->i", start, start) - radius**2
    root = half_b**2 - a * c
    level = a == 0
    meets = (root > 0) & ~level
    square = np.sqrt(np.where(meets, root, 0.0))
    divisor = np.where(level, 1.0, a)
    enters = np.clip((-half_b - square) / divisor, 0, 1)
    leaves = np.clip((-half_b + square) / divisor, 0, 1)
    always = level & (c < 0)
    return np.where(meets, enters, np.where(always, 0.0, 1.0)), np.where(meets, leaves, np.where(always, 1.0, 0.0))
