"""Straight paths through the obstacles of a world: their sections inside each shape, and the loss of a radio wave."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.model import Vector
from sim_backends.world.materials import FOLIAGE, MATERIALS, Solid
from sim_backends.world.shapes import Box, Cylinder, Floats, Shape
from sim_backends.world.world import World

_NEAR_M: Final = 0.001
"""Margin of bounding boxes against rounding errors. A path at this distance from a shape does not touch it."""


@dataclass(frozen=True)
class ObstacleCrossing:
    """The section of a path that is inside one shape of an obstacle.

    Attributes:
        obstacle: Name of the obstacle.
        material: Name of the material.
        length_m: Length of the section.
    """

    obstacle: str
    material: str
    length_m: float


class Obstacles:
    """The obstacles of a world, for the intersection with straight paths. It is immutable.

    Args:
        world: The world.
    """

    def __init__(self, world: World) -> None:
        self._parts = world.parts
        self._solids = Solids([part.shape for part in self._parts])
        self._materials = tuple(part.material for part in self._parts)

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> "Obstacles":
        return self  # it is immutable, so a run and its forks may share it

    def crossings(self, start_m: Floats, end_m: Floats) -> list[tuple[ObstacleCrossing, ...]]:
        """Return the shapes that each of n straight paths crosses, in the order of the file.

        Args:
            start_m: Starts of the paths, shape (n, 3).
            end_m: Ends of the paths, shape (n, 3).
        """
        return [
            tuple(
                ObstacleCrossing(part.obstacle, part.material, length_m)
                for part, length_m in zip(self._parts, lengths_m, strict=True)
                if length_m > 0
            )
            for lengths_m in self._solids.depths_m(start_m, end_m).tolist()
        ]

    def penetration_loss_db(self, start_m: Floats, end_m: Floats, frequency_hz: float) -> Floats:
        """Return the loss caused by obstacles along straight paths, in dB, shape (n,).

        A solid causes its loss per metre and the reflection loss of two faces, at normal incidence and without
        multiple reflections inside; the loss of foliage depends on the total depth. Diffraction is not modelled, so
        that a thick obstacle casts a deeper shadow than a real one.

        Args:
            start_m: Starts of the paths, shape (n, 3).
            end_m: Ends of the paths, shape (n, 3).
            frequency_hz: Frequency of the wave.
        """
        depths = self._solids.depths_m(start_m, end_m)
        if not depths.any():
            return np.zeros(len(start_m))
        db_per_m, faces_db, is_foliage = _material_losses(self._materials, frequency_hz)
        loss_db: Floats = depths @ db_per_m + (depths > 0) @ faces_db
        loss_db += [FOLIAGE.loss_db(depth_m, frequency_hz) for depth_m in (depths @ is_foliage).tolist()]
        return loss_db


@cache
def _material_losses(names: tuple[str, ...], frequency_hz: float) -> tuple[Floats, Floats, Floats]:
    """Return three arrays with an item per material.

    They contain the loss per metre in dB and the loss of two faces in dB, which are 0 for foliage, and a flag, which
    is 1 for foliage and 0 for a solid.
    """
    materials = [MATERIALS[name] for name in names]
    solids = [material if isinstance(material, Solid) else None for material in materials]
    return (
        np.array([solid.loss_db_per_m(frequency_hz) if solid else 0.0 for solid in solids]),
        np.array([2 * solid.face_loss_db(frequency_hz) if solid else 0.0 for solid in solids]),
        np.array([float(solid is None) for solid in solids]),
    )


class Solids:
    """Shapes, for the intersection with many paths.

    Args:
        shapes: m shapes.
    """

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self._count = len(shapes)
        boxes = [shape for shape in shapes if isinstance(shape, Box)]
        cylinders = [shape for shape in shapes if isinstance(shape, Cylinder)]
        is_box = np.array([isinstance(shape, Box) for shape in shapes], dtype=bool)
        self._kinds: list[tuple[NDArray[np.int64], Callable[..., Floats], tuple[Floats, ...]]] = [
            (np.flatnonzero(is_box), _in_boxes, (*_bounding_boxes(boxes), *_box_arrays(boxes))),
            (np.flatnonzero(~is_box), _in_cylinders, (*_bounding_boxes(cylinders), *_cylinder_arrays(cylinders))),
        ]

    def depths_m(self, start_m: Floats, end_m: Floats) -> Floats:
        """Return the length of each straight path inside each shape.

        Args:
            start_m: Starts of the paths, shape (n, 3).
            end_m: Ends of the paths, shape (n, 3).

        Returns:
            Lengths in metres, shape (n, m); 0 if a path misses or only touches a shape.
        """
        inside = np.zeros((self._count, len(start_m)))
        below_m, above_m = np.minimum(start_m, end_m), np.maximum(start_m, end_m)
        for indices, inside_share, (low_m, high_m, *arrays) in self._kinds:
            # Most shapes are far from all paths. Bounding boxes exclude them faster than the exact computation.
            candidates = ((above_m >= low_m) & (below_m <= high_m)).all(axis=-1).any(axis=-1)
            if candidates.any():
                inside[indices[candidates]] = inside_share(start_m, end_m, *(array[candidates] for array in arrays))
        depths: Floats = inside.T * np.linalg.norm(end_m - start_m, axis=1)[:, None]
        return depths


def _bounding_boxes(shapes: Sequence[Shape]) -> tuple[Floats, Floats]:
    """Return the lowest and the highest coordinates of each shape, with a small margin, shape (m, 1, 3)."""
    centre, half = _vectors(shape.centre_m for shape in shapes), _vectors(_half_m(shape) for shape in shapes)
    return centre - half - _NEAR_M, centre + half + _NEAR_M


def _half_m(shape: Shape) -> Vector:
    """Return the extent of a shape east, north and up from its centre."""
    if isinstance(shape, Cylinder):
        return shape.radius_m, shape.radius_m, shape.height_m / 2
    (long_m, wide_m, high_m), cos, sin = shape.size_m, abs(math.cos(shape.yaw_rad)), abs(math.sin(shape.yaw_rad))
    return (long_m * cos + wide_m * sin) / 2, (long_m * sin + wide_m * cos) / 2, high_m / 2


def _in_boxes(start_m: Floats, end_m: Floats, centre: Floats, half: Floats, turn: Floats) -> Floats:
    """Return the share of each path that is inside each box, shape (m, n)."""
    entry, exit_ = _slab((start_m - centre) @ turn, (end_m - centre) @ turn, half)
    inside: Floats = np.maximum(exit_.min(axis=-1) - entry.max(axis=-1), 0.0)
    return inside


def _in_cylinders(start_m: Floats, end_m: Floats, centre: Floats, radius: Floats, height: Floats) -> Floats:
    """Return the share of each path that is inside each cylinder, shape (m, n)."""
    start, end = start_m - centre, end_m - centre
    first, last = _disc(start[..., :2], end[..., :2], radius)
    below, above = _slab(start[..., 2], end[..., 2], height / 2)
    inside: Floats = np.maximum(np.minimum(last, above) - np.maximum(first, below), 0.0)
    return inside


def _box_arrays(boxes: Iterable[Box]) -> tuple[Floats, Floats, Floats]:
    """Return centres and half sizes, shape (m, 1, 3), and the rotations of row vectors into the axes of each box."""
    turns = [(math.cos(box.yaw_rad), math.sin(box.yaw_rad)) for box in boxes]
    turn = np.array([((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)) for cos, sin in turns]).reshape(-1, 3, 3)
    return _vectors(box.centre_m for box in boxes), _vectors(box.size_m for box in boxes) / 2, turn


def _cylinder_arrays(cylinders: Iterable[Cylinder]) -> tuple[Floats, Floats, Floats]:
    """Return centres, shape (m, 1, 3), and radii and heights, shape (m, 1)."""
    radius = np.array([cylinder.radius_m for cylinder in cylinders])[:, None]
    height = np.array([cylinder.height_m for cylinder in cylinders])[:, None]
    return _vectors(cylinder.centre_m for cylinder in cylinders), radius, height


def _vectors(points: Iterable[Vector]) -> Floats:
    """Return m points as shape (m, 1, 3), for broadcasting with n paths."""
    vectors: Floats = np.array(list(points), dtype=np.float64).reshape(-1, 1, 3)
    return vectors


def _slab(start: Floats, end: Floats, half: Floats) -> tuple[Floats, Floats]:
    """Return the fractions of each path, from 0 to 1, at which the path enters and leaves the range -half to half.

    The fractions are 1 and 0 if the path does not enter the range.
    """
    step = end - start
    is_parallel = step == 0  # to the planes at -half and half
    step = np.where(is_parallel, 1.0, step)
    with np.errstate(over="ignore"):  # an almost parallel path intersects the planes infinitely far away
        first, second = (-half - start) / step, (half - start) / step
    entry, exit_ = np.clip(np.minimum(first, second), 0, 1), np.clip(np.maximum(first, second), 0, 1)
    within = np.abs(start) < half
    return (
        np.where(is_parallel, np.where(within, 0.0, 1.0), entry),
        np.where(is_parallel, np.where(within, 1.0, 0.0), exit_),
    )


def _disc(start: Floats, end: Floats, radius: Floats) -> tuple[Floats, Floats]:
    """Return the fractions of each path at which the path enters and leaves a disc around the origin, as `_slab`.

    Paths are seen from above and have the shape (m, n, 2). The fractions are the roots of a quadratic equation.
    """
    step = end - start
    a = (step * step).sum(axis=-1)
    half_b = (start * step).sum(axis=-1)
    c = (start * start).sum(axis=-1) - radius**2
    discriminant = half_b**2 - a * c
    is_vertical = a == 0
    crosses = (discriminant > 0) & ~is_vertical
    root = np.sqrt(np.where(crosses, discriminant, 0.0))
    divisor = np.where(is_vertical, 1.0, a)
    entry = np.clip((-half_b - root) / divisor, 0, 1)
    exit_ = np.clip((-half_b + root) / divisor, 0, 1)
    stays_inside = is_vertical & (c < 0)
    return (
        np.where(crosses, entry, np.where(stays_inside, 0.0, 1.0)),
        np.where(crosses, exit_, np.where(stays_inside, 1.0, 0.0)),
    )
