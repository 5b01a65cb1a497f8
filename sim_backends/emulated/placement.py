"""Positions and paths of robots in the emulated world."""

import math
from collections.abc import Iterable
from typing import Final

from fieldkit.backends.protocols import Cast
from fieldkit.core import geometry
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Move, Placement, Role, Topology, Vector
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.emulated.ros.assigned_path import AssignedPath
from sim_backends.world.motion import Motion, OnGround, State, WayPoints
from sim_backends.world.world import Line, World

_OPERATOR_M: Final = 2.0
"""Distance of the operator's laptop from the robot that does not move."""


def positions_m(cast: Cast, placement: Placement, world: World) -> dict[str, Vector]:
    """Return the position of each antenna, metres east, north, up, on the world's line for the scenario.

    The line starts at the sender. If the scenario has an obstacle, the obstacle is near the sender (paper, section
    VI-A). `geometry.positions_m` determines the distances of the other robots from the sender.

    Raises:
        ConfigurationError: The world has no line for the scenario.
    """
    line = _line(placement, world)
    return {
        cast[role].name: antenna_m(world, line.at(from_sender_m, left_m))
        for role, (from_sender_m, left_m) in _along_line_m(placement).items()
        if role in cast
    }


def motion(cast: Cast, placement: Placement, move: Move, world: World) -> Motion:
    """Return the motion of a ground robot in a trial. Raises the errors of `positions_m`."""
    corners = [(*corner, 0.0) for corner in _corners_m(placement, move, world)]
    path = WayPoints(cast[move.role].name, corners, move.speed_m_s)
    return OnGround(path, lambda position_m: antenna_m(world, position_m)[2])


def assigned_path(placement: Placement, move: Move, world: World, start_ns: int) -> AssignedPath:
    """Return the path of a move in the form that the robot receives. Raises the errors of `positions_m`.

    The robot first faces away from the other end of its link.

    Args:
        placement: The scenario, the topology and the distance of the robots.
        move: The move; without legs the robot is at its place in the placement.
        world: The world around the robots.
        start_ns: Start of the move, as a time of the monotonic clock.
    """
    points_m = [antenna_m(world, corner) for corner in _corners_m(placement, move, world)]
    return AssignedPath(start_ns, points_m, move.speed_m_s, facing_rad(placement, move.role, world))


def facing_rad(placement: Placement, role: Role, world: World) -> float:
    """Return the heading of a robot at its place: away from the other end of its link."""
    line, (along_m, left_m) = _line(placement, world), _along_line_m(placement)[role]
    # 1 m ahead of the robot, which faces along the line (1) or against it (-1).
    ahead_m = math.cos(geometry.heading_rad(role, "away"))
    start, goal = line.at(along_m, left_m), line.at(along_m + ahead_m, left_m)
    return math.atan2(goal[1] - start[1], goal[0] - start[0])


def _corners_m(placement: Placement, move: Move, world: World) -> list[tuple[float, float]]:
    line, (start_along_m, start_left_m) = _line(placement, world), _along_line_m(placement)[move.role]
    return [
        line.at(start_along_m + along_m, start_left_m + left_m) for along_m, left_m in geometry.path_corners_m(move)
    ]


def _line(placement: Placement, world: World) -> Line:
    line = world.lines.get(placement.scenario)
    if line is None:
        raise ConfigurationError(
            f"the world {world.name} has no line for the positions of robots in the scenario {placement.scenario}",
            remedy=f"add lines: {{{placement.scenario}: {{from_m: [0, 0], bearing_deg: 90}}}} to it",
        )
    return line


def _along_line_m(placement: Placement) -> dict[Role, tuple[float, float]]:
    """Return the position of each role: metres from the sender along the line, and metres to the left of the line."""
    world_positions_m = geometry.positions_m(placement)
    sender_m = world_positions_m[Role.SENDER][0]
    return {role: (east_m - sender_m, north_m) for role, (east_m, north_m, _) in world_positions_m.items()}


def antenna_m(world: World, point_m: tuple[float, float]) -> Vector:
    """Return the position of a ground robot's antenna above a point on the ground, metres east and north."""
    return (*point_m, world.ground_m(point_m) + ANTENNA_M)


def on_ground(state: State, world: World) -> State:
    """Return the state of a ground robot with its antenna at the right height above the ground of the world."""
    return state._replace(position_m=antenna_m(world, state.position_m[:2]))


def side_by_side_m(names: Iterable[str]) -> dict[str, Vector]:
    """Return positions 1 m apart, which robots have from startup until they are placed."""
    return {name: (float(number), 0.0, 0.0) for number, name in enumerate(names)}


def laptop_m(cast: Cast, placement: Placement, world: World) -> Vector:
    """Return the position of the laptop: 2 m beside the robot that does not move.

    With a master this is the relay, because operators are near the access point. Without a master it is the receiver,
    because a person carries the sender, possibly behind a wall, and the laptop is never behind a wall.
    """
    stationary_role = Role.RELAY if placement.topology is Topology.MASTER else Role.RECEIVER
    east_m, north_m, up_m = positions_m(cast, placement, world)[cast[stationary_role].name]
    return east_m, north_m + _OPERATOR_M, up_m


def relay(cast: Cast, placement: Placement) -> str | None:
    """Return the robot whose access point carries the traffic, or None if robots communicate directly."""
    return cast[Role.RELAY].name if placement.topology is Topology.MASTER else None
