"""What a figure of a run shows from above beside the ways of its agents: obstacles, and where agents head."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.world.obstacles import Raised, Ramp
from sim_backends.world.shapes import Box
from sim_backends.world.world import World

Place = tuple[float, float]

_FLOOR_M: Final = 0.01
_ARROW_SHARE: Final = 0.04
"""How far back the direction of an arrow begins, of the diagonal of what its way covers."""


@dataclass(frozen=True)
class ObstacleOutline:
    """The outline of something from above.

    Attributes:
        corners_m: Its corners, metres east and north.
        is_light: Whether robots on the ground may be in it: below a roof or a crown, or on higher ground.
    """

    corners_m: Sequence[Place]
    is_light: bool


def outlines(world: World) -> Iterator[ObstacleOutline]:
    """Yield the outline of each part of what stands in a world, those of higher ground first."""
    for obstacle in sorted(world.obstacles, key=lambda one: not isinstance(one, Raised | Ramp)):
        for part in obstacle.parts():
            shape = part.shape
            high_m = shape.size_m[2] if isinstance(shape, Box) else shape.height_m
            is_above = shape.top_m - high_m > _FLOOR_M
            yield ObstacleOutline(shape.corners_m(), is_above or isinstance(obstacle, Raised | Ramp))


def last_heading(way_m: Sequence[Place]) -> tuple[Place, Place] | None:
    """Return the ends of an arrow at the end of a way, in the direction of travel; None if nothing moves."""
    east_m, north_m = way_m[-1]
    covered_m = math.hypot(*(max(axis) - min(axis) for axis in zip(*way_m, strict=True)))
    for from_e, from_n in reversed(way_m):
        back_m = math.dist((from_e, from_n), way_m[-1])
        if back_m >= max(_ARROW_SHARE * covered_m, _FLOOR_M):
            return (from_e, from_n), (east_m, north_m)
    return None
