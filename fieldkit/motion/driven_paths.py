"""Paths on which robots drive: their lengths, and their part inside a fence."""

import math
from collections.abc import Sequence
from itertools import accumulate

from fieldkit.core.model import Leg, Move


def clip_path(legs: Sequence[Leg], radius_m: float) -> tuple[Leg, ...]:
    """Return the part of a path before it first leaves a circle around its start.

    Args:
        legs: The path.
        radius_m: Radius of the circle.
    """
    legs_inside: list[Leg] = []
    x, y = 0.0, 0.0
    for leg in legs:
        dx, dy = leg.away_m, leg.left_m
        if math.hypot(x + dx, y + dy) > radius_m:
            # Solve |(x, y) + share (dx, dy)| = radius. (x, y) is inside, so the larger solution is the positive one.
            dot, squared_length = x * dx + y * dy, dx**2 + dy**2
            share = (math.sqrt(dot**2 + squared_length * (radius_m**2 - x**2 - y**2)) - dot) / squared_length
            return (*legs_inside, Leg(share * dx, share * dy)) if share > 0 else tuple(legs_inside)
        legs_inside.append(leg)
        x, y = x + dx, y + dy
    return tuple(legs_inside)


def farthest_m(legs: Sequence[Leg]) -> float:
    """Return the largest distance of a path from its start, in metres."""
    corners = accumulate(
        legs, lambda corner, leg: (corner[0] + leg.away_m, corner[1] + leg.left_m), initial=(0.0, 0.0)
    )
    return max(math.hypot(*corner) for corner in corners)


def length_m(move: Move) -> float:
    """Return the length of a path in metres."""
    return sum(math.hypot(leg.away_m, leg.left_m) for leg in move.legs)
