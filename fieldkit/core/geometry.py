"""Geometry of a placement: the places of its robots, and the directions in which they move."""

import math
from collections.abc import Mapping, Sequence
from itertools import accumulate

from fieldkit.core.model import Leg, Move, Placement, Role, Topology, Vector


def positions_m(placement: Placement) -> Mapping[Role, Vector]:
    """Return where each role stands, in metres east, north, up.

    Master: the relay at the origin, the stations on opposite sides of it, each the distance away. Masterless: the
    sender at the origin, the receiver the distance east of it; a relay takes no part. Robots in roles of the
    procedure's own stand where their posts are.
    """
    distance_m = placement.distance.metres
    if placement.topology is Topology.MASTER:
        east_m = {Role.RELAY: 0.0, Role.SENDER: -distance_m, Role.RECEIVER: distance_m}
    else:
        east_m = {Role.SENDER: 0.0, Role.RECEIVER: distance_m}
    places_m: dict[Role, Vector] = {role: (at_m, 0.0, 0.0) for role, at_m in east_m.items()}
    for post in placement.posts:
        along_m, left_m = _from_m(post.near, post.leg)
        places_m[post.role] = (east_m[post.near] + along_m, left_m, 0.0)
    return places_m


def _from_m(role: Role, leg: Leg) -> tuple[float, float]:
    """Return where a leg from a robot ends: so far along the line from sender to receiver, and to its left."""
    # The sender looks away from the others along the line, so its left is the line's right.
    sign = -1.0 if role == Role.SENDER else 1.0
    return sign * leg.away_m, sign * leg.left_m


def heading_rad(role: Role, facing: str) -> float:
    """Return where a robot faces, from the line from sender to receiver towards its left.

    Args:
        role: Whose robot.
        facing: `away`, `towards`, `left` or `right`, as who looks away from the other end of its link sees it.
    """
    turned_rad = {"away": 0.0, "left": math.pi / 2, "towards": math.pi, "right": -math.pi / 2}[facing]
    return turned_rad + (math.pi if role == Role.SENDER else 0.0)


def other_end(role: Role, topology: Topology) -> Role:
    """Return the robot at the other end of a robot's link; of the relay's two links, the sender's."""
    if role == Role.RELAY:
        return Role.SENDER
    if topology is Topology.MASTER:
        return Role.RELAY
    return Role.RECEIVER if role == Role.SENDER else Role.SENDER


def way_m(move: Move) -> tuple[tuple[float, float], ...]:
    """Return the corners of a way, the first where the robot stands.

    Each is so many metres from there along the line from sender to receiver, and so many to its left.
    """
    steps = (_from_m(move.role, leg) for leg in move.legs)
    return tuple(accumulate(steps, lambda at, step: (at[0] + step[0], at[1] + step[1]), initial=(0.0, 0.0)))


def within(legs: Sequence[Leg], radius_m: float) -> tuple[Leg, ...]:
    """Return the part of a way that leads no farther than a distance from where it begins; it ends at that distance.

    Args:
        legs: The way.
        radius_m: The distance.
    """
    kept: list[Leg] = []
    x, y = 0.0, 0.0
    for leg in legs:
        dx, dy = leg.away_m, leg.left_m
        if math.hypot(x + dx, y + dy) > radius_m:
            # The larger s with |(x, y) + s (dx, dy)| = radius: the place is inside, so the smaller one is behind it.
            along, long = x * dx + y * dy, dx**2 + dy**2
            share = (math.sqrt(along**2 + long * (radius_m**2 - x**2 - y**2)) - along) / long
            return (*kept, Leg(share * dx, share * dy)) if share > 0 else tuple(kept)
        kept.append(leg)
        x, y = x + dx, y + dy
    return tuple(kept)


def farthest_m(legs: Sequence[Leg]) -> float:
    """Return how far a way leads at most from where it begins."""
    corners = accumulate(legs, lambda at, leg: (at[0] + leg.away_m, at[1] + leg.left_m), initial=(0.0, 0.0))
    return max(math.hypot(*corner) for corner in corners)


def length_m(move: Move) -> float:
    """Return how long a way is."""
    return sum(math.hypot(leg.away_m, leg.left_m) for leg in move.legs)


def in_words(move: Move) -> str:
    """Return a way and its speed in words: `10 m away, then 2 m left, at 0.2 m/s`."""
    return f"{', then '.join(map(leg_in_words, move.legs))}, at {move.speed_m_s:g} m/s"


def leg_in_words(leg: Leg) -> str:
    """Return a straight piece of a way in words: `10 m away and 2 m left`."""
    directions = (leg.away_m, ("away", "towards")), (leg.left_m, ("left", "right"))
    return " and ".join(f"{abs(metres):g} m {words[metres < 0]}" for metres, words in directions if metres)
