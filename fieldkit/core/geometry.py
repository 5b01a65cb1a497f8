"""Geometry of a placement: the places of its robots, and the directions in which they move."""

import math
from collections.abc import Mapping
from itertools import accumulate

from fieldkit.core.model import Move, Placement, Role, Topology, Vector


def positions_m(placement: Placement) -> Mapping[Role, Vector]:
    """Return where each role stands, in metres east, north, up.

    Master: the relay at the origin, the stations on opposite sides of it, each the distance away. Masterless: the
    sender at the origin, the receiver the distance east of it; a relay takes no part.
    """
    distance_m = placement.distance.metres
    if placement.topology is Topology.MASTER:
        return {
            Role.RELAY: (0.0, 0.0, 0.0),
            Role.SENDER: (-distance_m, 0.0, 0.0),
            Role.RECEIVER: (distance_m, 0.0, 0.0),
        }
    return {Role.SENDER: (0.0, 0.0, 0.0), Role.RECEIVER: (distance_m, 0.0, 0.0)}


def other_end(role: Role, topology: Topology) -> Role:
    """Return the robot at the other end of a robot's link; of the relay's two links, the sender's."""
    if role is Role.RELAY:
        return Role.SENDER
    if topology is Topology.MASTER:
        return Role.RELAY
    return Role.RECEIVER if role is Role.SENDER else Role.SENDER


def way_m(move: Move) -> tuple[tuple[float, float], ...]:
    """Return the corners of a way, the first where the robot stands.

    Each is so many metres from there along the line from sender to receiver, and so many to its left.
    """
    # The sender looks away from the others along the line, so its left is the line's right.
    sign = -1.0 if move.role is Role.SENDER else 1.0
    steps = ((sign * leg.away_m, sign * leg.left_m) for leg in move.legs)
    return tuple(accumulate(steps, lambda at, step: (at[0] + step[0], at[1] + step[1]), initial=(0.0, 0.0)))


def length_m(move: Move) -> float:
    """Return how long a way is."""
    return sum(math.hypot(leg.away_m, leg.left_m) for leg in move.legs)


def in_words(move: Move) -> str:
    """Return a way and its speed in words: `10 m away, then 2 m left, at 0.2 m/s`."""
    legs = (
        " and ".join(
            f"{abs(metres):g} m {words[metres < 0]}"
            for metres, words in ((leg.away_m, ("away", "towards")), (leg.left_m, ("left", "right")))
            if metres
        )
        for leg in move.legs
    )
    return f"{', then '.join(legs)}, at {move.speed_m_s:g} m/s"
