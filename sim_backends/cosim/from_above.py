"""The parts of a run's map besides the paths of its agents: obstacles seen from above, and directions of travel."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.world.obstacles import Raised, Ramp
from sim_backends.world.shapes import Box
from sim_backends.world.world import World

Point = tuple[float, float]

_FLOOR_M: Final = 0.01
_ARROW_SHARE: Final = 0.04
"""Length of an arrow, as a share of the diagonal of the rectangle that the path covers."""


@dataclass(frozen=True)
class ObstacleOutline:
    """The outline of an obstacle, seen from above.

    Attributes:
        corners_m: Its corners, metres east and north.
        is_light: True if robots on the ground may be within the outline: below a roof or a tree crown, or on higher
            ground.
    """

    corners_m: Sequence[Point]
    is_light: bool


def outlines(world: World) -> Iterator[ObstacleOutline]:
    """Yield the outline of each part of a world's obstacles, those of higher ground first."""
    for obstacle in sorted(world.obstacles, key=lambda obstacle: not isinstance(obstacle, Raised | Ramp)):
        for part in obstacle.parts():
            shape = part.shape
            height_m = shape.size_m[2] if isinstance(shape, Box) else shape.height_m
            is_above = shape.top_m - height_m > _FLOOR_M
            yield ObstacleOutline(shape.corners_m(), is_above or isinstance(obstacle, Raised | Ramp))


def last_heading(path_m: Sequence[Point]) -> tuple[Point, Point] | None:
    """Return both ends of an arrow at the end of a path, in the direction of travel; None if nothing moves."""
    east_m, north_m = path_m[-1]
    covered_m = math.hypot(*(max(axis) - min(axis) for axis in zip(*path_m, strict=True)))
    for from_e, from_n in reversed(path_m):
        back_m = math.dist((from_e, from_n), path_m[-1])
        if back_m >= max(_ARROW_SHARE * covered_m, _FLOOR_M):
            return (from_e, from_n), (east_m, north_m)
    return None
