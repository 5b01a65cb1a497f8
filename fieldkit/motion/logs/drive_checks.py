"""Contradictions between the log of a drive, the commanded path and speed, and the attempt."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Final

from fieldkit.core.model import Leg
from fieldkit.motion.logs.drive_log import HOME, DriveMoment, speeds_m_s
from fieldkit.motion.logs.motion_log import time_contradictions

MAX_DEVIATION_M: Final = 1.0
"""Largest acceptable deviation from the path. The control loop uses the same odometry, so on even ground the
deviation is a few centimetres."""

_START_M: Final = 0.3
"""Largest distance of the start from the origin. It equals `START_M` of `fieldkit.agent.driving.drive_plan`; a test
checks this."""
_ROUNDING_M: Final = 2e-3
"""Positions are rounded to 0.1 mm, the driven distance to 1 mm."""
_JITTER_M: Final = 0.05
_JITTER_SHARE: Final = 0.25
"""Tolerance for jitter of the odometry, which makes the driven distance between two lines of the log longer than the
distance between their positions."""
_SPEED_SHARE: Final = 1.5
_SPEED_M_S: Final = 0.1
"""Tolerance of a speed that is averaged over half a second: the control may overshoot, and the distance of one more
odometry message may fall into this time."""
_COMMAND_M_S: Final = 1e-3
"""Tolerance of a commanded speed, which the log has rounded."""
_COAST_M: Final = 1.0
_COAST_SHARE: Final = 0.1
"""Tolerance of the distance driven at a commanded speed of 0, and its increase per driven metre. After a command to
stop, a robot coasts, and its position shifts while it turns."""


@dataclass(frozen=True)
class DrivePlan:
    """Commanded drive of a robot.

    Attributes:
        legs: The path from the robot's position.
        speed_m_s: The speed.
        window: Readings of the robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if
            unknown.
    """

    legs: tuple[Leg, ...]
    speed_m_s: float
    window: tuple[int, int] | None


def contradictions(log: Sequence[DriveMoment], plan: DrivePlan) -> Iterator[str]:
    """Yield the contradictions in the log of a successful drive, one sentence each."""
    if log[-1].ended != HOME or any(moment.ended for moment in log[:-1]):
        yield f"does not end at the starting position of the robot: {log[-1].ended or 'it ends on the path'}"
    yield from time_contradictions(log, plan.window)
    # A drive starts up to `_START_M` from its origin, and the robot may have driven before the first line.
    start_m, driven_m = log[0].distance_m, log[0].driven_m
    if not start_m - _START_M <= driven_m <= (1 + _JITTER_SHARE) * (start_m + _START_M) + _JITTER_M:
        yield f"starts {start_m:.2f} m from its origin, after {driven_m:.2f} m driven"
    if any(_jumps(*pair) for pair in pairwise(log)):
        yield "the distance between two consecutive poses differs from the driven distance"
    deviation_m = max(_deviation_m(moment, plan.legs) for moment in log)
    if deviation_m > MAX_DEVIATION_M:
        yield f"its odometry deviates by {deviation_m:.1f} m from the commanded path"
    fastest_m_s = max(speeds_m_s(log), default=0.0)
    if fastest_m_s > _SPEED_SHARE * plan.speed_m_s + _SPEED_M_S:
        yield f"it drove at {fastest_m_s:.2f} m/s instead of {plan.speed_m_s:g} m/s"
    if not all(0 <= moment.forward_m_s <= plan.speed_m_s + _COMMAND_M_S for moment in log):
        yield f"a commanded speed is not between 0 and {plan.speed_m_s:g} m/s"
    if _coasting_distance_m(log) > _COAST_M + _COAST_SHARE * log[-1].driven_m:
        yield f"it drove {_coasting_distance_m(log):.1f} m while the commanded speed was 0"


def _jumps(before: DriveMoment, after: DriveMoment) -> bool:
    """Return True if the positions of two lines of the log do not agree with the driven distance between them."""
    straight_m = math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
    driven_m = after.driven_m - before.driven_m
    return not straight_m - _ROUNDING_M <= driven_m <= (1 + _JITTER_SHARE) * straight_m + _JITTER_M


def _coasting_distance_m(log: Sequence[DriveMoment]) -> float:
    """Return the distance driven between consecutive lines of the log that both have a commanded speed of 0."""
    return sum(
        math.hypot(after.x_m - before.x_m, after.y_m - before.y_m)
        for before, after in pairwise(log)
        if not before.forward_m_s and not after.forward_m_s
    )


def _deviation_m(moment: DriveMoment, legs: Sequence[Leg]) -> float:
    """Return the distance of a robot from the nearest segment of its path."""
    corners = list(
        accumulate(legs, lambda corner, leg: (corner[0] + leg.away_m, corner[1] + leg.left_m), initial=(0.0, 0.0))
    )
    return min(_distance_m((moment.x_m, moment.y_m), start, end) for start, end in pairwise(corners))


def _distance_m(point: tuple[float, float], start: tuple[float, float], end: tuple[float, float]) -> float:
    """Return the distance of a point from a line segment."""
    segment = end[0] - start[0], end[1] - start[1]
    offset = point[0] - start[0], point[1] - start[1]
    squared_length = segment[0] ** 2 + segment[1] ** 2
    dot = offset[0] * segment[0] + offset[1] * segment[1]
    share = min(max(dot / squared_length, 0.0), 1.0) if squared_length else 0.0
    return math.hypot(offset[0] - share * segment[0], offset[1] - share * segment[1])
