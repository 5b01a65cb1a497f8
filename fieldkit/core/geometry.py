"""Geometry of a placement: positions, headings and paths of its robots."""

import math
from collections.abc import Mapping
from itertools import accumulate

from fieldkit.core.model import Leg, Move, Placement, Role, Topology, Vector


def positions_m(placement: Placement) -> Mapping[Role, Vector]:
    """Return the position of each role, in metres east, north, up.

    Master: the relay is at the origin, and the stations are on opposite sides of it, each at the placement's
    distance. Masterless: the sender is at the origin, and the receiver is at this distance east of it; there is no
    relay. Robots in additional roles are at their posts.
    """
    distance_m = placement.distance.metres
    if placement.topology is Topology.MASTER:
        east_m = {Role.RELAY: 0.0, Role.SENDER: -distance_m, Role.RECEIVER: distance_m}
    else:
        east_m = {Role.SENDER: 0.0, Role.RECEIVER: distance_m}
    by_role: dict[Role, Vector] = {role: (x_m, 0.0, 0.0) for role, x_m in east_m.items()}
    for post in placement.posts:
        along_m, left_m = _leg_vector_m(post.near, post.leg)
        by_role[post.role] = (east_m[post.near] + along_m, left_m, 0.0)
    return by_role


def _leg_vector_m(role: Role, leg: Leg) -> tuple[float, float]:
    """Return a leg of a robot as a vector: metres along the line from sender to receiver, and metres to its left."""
    # The sender faces against the direction of the line, so its left is the right side of the line.
    sign = -1.0 if role == Role.SENDER else 1.0
    return sign * leg.away_m, sign * leg.left_m


def heading_rad(role: Role, facing: str) -> float:
    """Return the heading of a robot in radians, counterclockwise from the line from sender to receiver.

    Args:
        role: The robot's role.
        facing: `away`, `towards`, `left` or `right`, relative to the direction away from the other end of its link.
    """
    turn_rad = {"away": 0.0, "left": math.pi / 2, "towards": math.pi, "right": -math.pi / 2}[facing]
    return turn_rad + (math.pi if role == Role.SENDER else 0.0)


def other_end(role: Role, topology: Topology) -> Role:
    """Return the role at the other end of a robot's link. For the relay, which has two links, this is the sender."""
    if role == Role.RELAY:
        return Role.SENDER
    if topology is Topology.MASTER:
        return Role.RELAY
    return Role.RECEIVER if role == Role.SENDER else Role.SENDER


def path_corners_m(move: Move) -> tuple[tuple[float, float], ...]:
    """Return the corners of a path; the first is the robot's initial position, (0, 0).

    The coordinates are metres along the line from sender to receiver, and metres to its left.
    """
    steps = (_leg_vector_m(move.role, leg) for leg in move.legs)
    return tuple(
        accumulate(steps, lambda corner, step: (corner[0] + step[0], corner[1] + step[1]), initial=(0.0, 0.0))
    )


def describe_move(move: Move) -> str:
    """Return a description of a path and its speed: `10 m away, then 2 m left, at 0.2 m/s`."""
    return f"{', then '.join(map(describe_leg, move.legs))}, at {move.speed_m_s:g} m/s"


def describe_leg(leg: Leg) -> str:
    """Return a description of one leg of a path: `10 m away and 2 m left`."""
    directions = (leg.away_m, ("away", "towards")), (leg.left_m, ("left", "right"))
    return " and ".join(f"{abs(metres):g} m {words[metres < 0]}" for metres, words in directions if metres)
