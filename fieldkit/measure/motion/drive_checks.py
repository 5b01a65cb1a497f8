"""Contradictions in the log of a drive: with itself, with the way and speed that were asked for, with the attempt."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Final

from fieldkit.core.model import Leg
from fieldkit.measure.motion.drive_log import HOME, DriveMoment, speeds_m_s
from fieldkit.measure.motion.motion_log import time_contradictions

OFF_WAY_M: Final = 1.0
"""A driver steers on its own odometry, within centimetres on even ground; one that is this far off is lost."""

_START_M: Final = 0.3
"""How far from its origin a robot may start: `START_M` of `fieldkit.agent.drive_plan`, which a test compares."""
_ROUNDING_M: Final = 2e-3
"""Places are written to 0.1 mm, the way that was driven to 1 mm."""
_NOISE_M: Final = 0.05
_NOISE_SHARE: Final = 0.25
"""Between two lines odometry that jitters counts a longer way than the straight one."""
_SPEED_SHARE: Final = 1.5
_SPEED_M_S: Final = 0.1
"""A speed over half a second may be too large by a message of odometry, and by how a robot overshoots."""
_COMMAND_M_S: Final = 1e-3
_COAST_M: Final = 1.0
_COAST_SHARE: Final = 0.1
"""A robot that is commanded to stop rolls on, and its place shifts while it turns."""


@dataclass(frozen=True)
class DrivePlan:
    """What a robot was asked to drive.

    Attributes:
        legs: The way from its place.
        speed_m_s: How fast.
        window: The robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if it is not known.
    """

    legs: tuple[Leg, ...]
    speed_m_s: float
    window: tuple[int, int] | None


def contradictions(log: Sequence[DriveMoment], plan: DrivePlan) -> Iterator[str]:
    """Yield what cannot be true of a drive that ended well, a sentence each."""
    if log[-1].ended != HOME or any(moment.ended for moment in log[:-1]):
        yield f"does not end with the robot at its place, but {log[-1].ended or 'on its way'}"
    yield from time_contradictions(log, plan.window)
    if not log[0].off_m - _START_M <= log[0].driven_m <= (1 + _NOISE_SHARE) * (log[0].off_m + _START_M) + _NOISE_M:
        yield f"begins {log[0].off_m:.2f} m from its place, after {log[0].driven_m:.2f} m"
    if any(_jumps(*pair) for pair in pairwise(log)):
        yield "a pose is not as far from the one before it as the wheels went"
    off_m = max(_off_way_m(moment, plan.legs) for moment in log)
    if off_m > OFF_WAY_M:
        yield f"its odometry was {off_m:.1f} m off the way that was asked for"
    fastest_m_s = max(speeds_m_s(log), default=0.0)
    if fastest_m_s > _SPEED_SHARE * plan.speed_m_s + _SPEED_M_S:
        yield f"it drove at {fastest_m_s:.2f} m/s, and was to drive at {plan.speed_m_s:g} m/s"
    if not all(0 <= moment.forward_m_s <= plan.speed_m_s + _COMMAND_M_S for moment in log):
        yield f"it was commanded to drive at another speed than 0 to {plan.speed_m_s:g} m/s"
    if _coasted_m(log) > _COAST_M + _COAST_SHARE * log[-1].driven_m:
        yield f"it drove {_coasted_m(log):.1f} m while it was commanded to stand"


def _jumps(before: DriveMoment, after: DriveMoment) -> bool:
    """Return whether two lines have places that the way between them does not explain."""
    straight_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
    driven_m = after.driven_m - before.driven_m
    return not straight_m - _ROUNDING_M <= driven_m <= (1 + _NOISE_SHARE) * straight_m + _NOISE_M


def _coasted_m(log: Sequence[DriveMoment]) -> float:
    """Return how far a robot went between lines that both say that it was commanded to stand."""
    return sum(
        math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
        for before, after in pairwise(log)
        if not before.forward_m_s and not after.forward_m_s
    )


def _off_way_m(moment: DriveMoment, legs: Sequence[Leg]) -> float:
    """Return how far a robot is from the nearest piece of its way."""
    corners = list(accumulate(legs, lambda at, leg: (at[0] + leg.away_m, at[1] + leg.left_m), initial=(0.0, 0.0)))
    return min(_distance_m((moment.x_m, moment.y_m), begin, end) for begin, end in pairwise(corners))


def _distance_m(place: tuple[float, float], begin: tuple[float, float], end: tuple[float, float]) -> float:
    along = end[0] - begin[0], end[1] - begin[1]
    off = place[0] - begin[0], place[1] - begin[1]
    square = along[0] ** 2 + along[1] ** 2
    share = min(max((off[0] * along[0] + off[1] * along[1]) / square, 0.0), 1.0) if square else 0.0
    return math.hypot(off[0] - share * along[0], off[1] - share * along[1])
