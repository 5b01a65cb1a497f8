"""Positions of the robots of an interactive lab: at its start, and after a move."""

import math
from collections.abc import Collection
from typing import Final

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from fieldkit.lab.robots import Destination
from sim_backends.emulated.placement import antenna_m
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.world.world import World

_SPACING_M: Final = 5.0
"""Maximum distance of neighbouring robots in an interactive lab."""

_CEILING_M: Final = 100_000.0
"""Maximum height of a flying robot above the ground. The FAI defines this height above sea level as the boundary of
space."""


def square_m(names: Collection[str], world: World) -> dict[str, Vector]:
    """Return antenna positions on a square grid in the middle of a world, at most 5 m apart, southwest first."""
    side = math.ceil(math.sqrt(len(names)))
    spacing_m = min(_SPACING_M, min(world.area_m) / side)
    west_m, south_m = (extent_m / 2 - (side - 1) * spacing_m / 2 for extent_m in world.area_m)
    return {
        name: antenna_m(world, (west_m + number % side * spacing_m, south_m + number // side * spacing_m))
        for number, name in enumerate(names)
    }


def destination_m(start_m: Vector, to: Destination, world: World) -> Vector:
    """Return the position of an antenna after a move.

    Args:
        start_m: Its position before the move.
        to: The destination.
        world: The world around the robot.

    Raises:
        ConfigurationError: The destination is outside the world, below its ground, or more than 100 km above it.
    """
    origin_m = start_m[:2] if to.relative else (0.0, 0.0)
    end_m = origin_m[0] + to.east_m, origin_m[1] + to.north_m
    width_m, depth_m = world.area_m
    if not (0 <= end_m[0] <= width_m and 0 <= end_m[1] <= depth_m):
        raise ConfigurationError(
            f"{end_m[0]:g} m east, {end_m[1]:g} m north is outside of the world {world.name}, which is "
            f"{width_m:g} m by {depth_m:g} m",
            remedy="choose a position inside it, or select a larger world with emulated.world in the site file; see: "
            "fieldkit docs world-file",
        )
    ground_m = world.ground_m(end_m)
    if to.relative:
        above_ground_m = start_m[2] - world.ground_m(start_m[:2]) + (to.up_m or 0.0)
    else:
        above_ground_m = ANTENNA_M if to.up_m is None else to.up_m - ground_m
    up_m = ground_m + above_ground_m
    if not 0 <= above_ground_m <= _CEILING_M:
        raise ConfigurationError(
            f"{up_m:g} m up is not a valid height: the ground is at {ground_m:g} m there, and nothing flies more "
            f"than {_CEILING_M / 1000:g} km above it",
            remedy=f"omit UP for a robot on the ground, whose antenna is {ANTENNA_M:g} m above it",
        )
    return *end_m, up_m


def below_antenna_m(antenna_m: Vector) -> Vector:
    """Return the lowest point of a robot whose antenna is at `antenna_m`."""
    east_m, north_m, up_m = antenna_m
    return east_m, north_m, up_m - ANTENNA_M
