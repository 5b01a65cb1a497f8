"""Places of robots in the emulated world."""

import math
from collections.abc import Collection, Iterable
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.core import geometry
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Move, Placement, Role, Topology, Vector
from fieldkit.lab.protocol import Destination
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.own_motion import OwnWay
from sim_backends.world.motion import Motion, OnGround, State, WayPoints
from sim_backends.world.world import Line, World

_OPERATOR_M: Final = 2.0
_APART_M: Final = 5.0

_CEILING_M: Final = 100_000.0
"""Nothing flies higher: space begins there (FAI)."""


def positions_m(cast: Cast, placement: Placement, world: World) -> dict[str, Vector]:
    """Return each antenna's place in metres east, north, up, along the line that the world has for the scenario.

    The sender stands at its end, without line of sight behind what is in the way (paper, section VI-A), the others as
    far from it as `geometry.positions_m` says.

    Raises:
        ConfigurationError: The world has no line for the scenario.
    """
    line = _line(placement, world)
    return {
        cast[role].name: antenna_m(world, line.at(from_sender_m, left_m))
        for role, (from_sender_m, left_m) in _along_m(placement).items()
        if role in cast
    }


def motion(cast: Cast, placement: Placement, move: Move, world: World) -> Motion:
    """Return how a robot of a trial moves on the ground; errors as `positions_m`."""
    corners = [(*corner, 0.0) for corner in _corners_m(placement, move, world)]
    way = WayPoints(cast[move.role].name, corners, move.speed_m_s)
    return OnGround(way, lambda place_m: antenna_m(world, place_m)[2])


def own_way(placement: Placement, move: Move, world: World, began_ns: int) -> OwnWay:
    """Return a move as the robot itself is told it; errors as `positions_m`.

    At its place it faces away from the other end of its link.

    Args:
        placement: Where robots stand.
        move: Who goes where; without a leg it stays in its place.
        world: What they stand in.
        began_ns: When it begins, by the monotonic clock.
    """
    line, (from_m, off_m) = _line(placement, world), _along_m(placement)[move.role]
    ahead_m = math.cos(geometry.heading_rad(move.role, "away"))
    here, ahead = line.at(from_m, off_m), line.at(from_m + ahead_m, off_m)
    facing_rad = math.atan2(ahead[1] - here[1], ahead[0] - here[0])
    points_m = [antenna_m(world, corner) for corner in _corners_m(placement, move, world)]
    return OwnWay(began_ns, points_m, move.speed_m_s, facing_rad)


def _corners_m(placement: Placement, move: Move, world: World) -> list[tuple[float, float]]:
    line, (from_m, off_m) = _line(placement, world), _along_m(placement)[move.role]
    return [line.at(from_m + along_m, off_m + left_m) for along_m, left_m in geometry.way_m(move)]


def _line(placement: Placement, world: World) -> Line:
    line = world.lines.get(placement.scenario)
    if line is None:
        raise ConfigurationError(
            f"the world {world.name} says not where robots stand for the scenario {placement.scenario}",
            remedy=f"add lines: {{{placement.scenario}: {{from_m: [0, 0], bearing_deg: 90}}}} to it",
        )
    return line


def _along_m(placement: Placement) -> dict[Role, tuple[float, float]]:
    """Return how far from the sender each role stands along the line, and how far to the left of it."""
    places_m = geometry.positions_m(placement)
    sender_m = places_m[Role.SENDER][0]
    return {role: (east_m - sender_m, north_m) for role, (east_m, north_m, _) in places_m.items()}


def antenna_m(world: World, place_m: tuple[float, float]) -> Vector:
    """Return the place of a ground robot's antenna over a place on the ground, metres east and north."""
    return (*place_m, world.ground_m(place_m) + ANTENNA_M)


def on_ground(state: State, world: World) -> State:
    """Return the state of a robot that drives, whose antenna is over the ground of the world."""
    return state._replace(position_m=antenna_m(world, state.position_m[:2]))


def together_m(names: Iterable[str]) -> dict[str, Vector]:
    """Return places 1 m apart: where everything is switched on, before anybody carries it away."""
    return {name: (float(number), 0.0, 0.0) for number, name in enumerate(names)}


def square_m(names: Collection[str], world: World) -> dict[str, Vector]:
    """Return antennas' places in a square in the middle of a world, 5 m apart or less, the first in the southwest."""
    side = math.ceil(math.sqrt(len(names)))
    apart_m = min(_APART_M, min(world.area_m) / side)
    west_m, south_m = (extent_m / 2 - (side - 1) * apart_m / 2 for extent_m in world.area_m)
    return {
        name: antenna_m(world, (west_m + number % side * apart_m, south_m + number // side * apart_m))
        for number, name in enumerate(names)
    }


def moved_m(place_m: Vector, to: Destination, world: World) -> Vector:
    """Return where an antenna is after a move.

    Args:
        place_m: Where it was.
        to: Where it goes.
        world: What it is in.

    Raises:
        ConfigurationError: That is outside of the world, under its ground, or higher than anything flies.
    """
    start_m = place_m[:2] if to.relative else (0.0, 0.0)
    end_m = start_m[0] + to.east_m, start_m[1] + to.north_m
    width_m, depth_m = world.area_m
    if not (0 <= end_m[0] <= width_m and 0 <= end_m[1] <= depth_m):
        raise ConfigurationError(
            f"{end_m[0]:g} m east, {end_m[1]:g} m north is outside of the world {world.name}, which is "
            f"{width_m:g} m by {depth_m:g} m",
            remedy="choose a place in it, or a larger one by emulated.world in the site file; see: fieldkit docs "
            "world-file",
        )
    ground_m = world.ground_m(end_m)
    if to.relative:
        over_ground_m = place_m[2] - world.ground_m(place_m[:2]) + (to.up_m or 0.0)
    else:
        over_ground_m = ANTENNA_M if to.up_m is None else to.up_m - ground_m
    up_m = ground_m + over_ground_m
    if not 0 <= over_ground_m <= _CEILING_M:
        raise ConfigurationError(
            f"{up_m:g} m up is no place: the ground is at {ground_m:g} m there, and nothing flies above "
            f"{_CEILING_M / 1000:g} km",
            remedy=f"leave UP out for a robot on the ground, whose antenna is {ANTENNA_M:g} m above it",
        )
    return *end_m, up_m


def laptop_m(cast: Cast, placement: Placement, world: World) -> Vector:
    """Return where the operator holds the laptop: 2 m beside the robot that stays in its place.

    That is the relay in master, as near to the access point as people sit, and the receiver in masterless, because a
    person carries the sender (behind the wall, too, where the laptop never is).
    """
    stays = Role.RELAY if placement.topology is Topology.MASTER else Role.RECEIVER
    east_m, north_m, up_m = positions_m(cast, placement, world)[cast[stays].name]
    return east_m, north_m + _OPERATOR_M, up_m


def relay(cast: Cast, placement: Placement) -> str | None:
    """Return the robot whose access point carries the traffic, None where robots talk directly."""
    return cast[Role.RELAY].name if placement.topology is Topology.MASTER else None
