"""Contradictions between the log of a flight, the commanded flight, the attempt, and telemetry."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from fieldkit.agent.flying.flight_plan import PHASES
from fieldkit.measure.captures.arrays import Floats
from fieldkit.motion.logs.fly_log import FlightMoment
from fieldkit.motion.logs.motion_log import time_contradictions

POSITION_ERROR_M: Final = 5.0
"""Tolerance for errors and jumps of an autopilot's position estimate: the 95 % error of satellite positioning under
open sky."""

_SPEED_SHARE: Final = 1.5
_SPEED_M_S: Final = 2.0
"""Tolerance of the speed for wind, overshoot, and a landing that the autopilot controls."""


@dataclass(frozen=True)
class FlyPlan:
    """Commanded flight of a drone.

    Attributes:
        highest_m: Largest height over the ground from which the drone takes off.
        farthest_m: Largest horizontal distance from the origin of the trial's flights (see `fly_log`).
        fastest_m_s: Speed limit.
        window: Readings of the clock of the drone's computer before and after the attempt, nanoseconds since 1970
            UTC; None if unknown.
    """

    highest_m: float
    farthest_m: float
    fastest_m_s: float
    window: tuple[int, int] | None


def contradictions(log: Sequence[FlightMoment], plan: FlyPlan) -> Iterator[str]:
    """Yield the contradictions in the log of a successful flight, one sentence each."""
    ranks = [PHASES.index(moment.phase) for moment in log]
    if ranks != sorted(ranks):
        yield "its phases are not in the order of a flight"
    if log[-1].phase != PHASES[-1]:
        yield f"ends while the drone was {log[-1].phase}, not {PHASES[-1]}"
    yield from time_contradictions(log, plan.window)
    if any(_jumps(*pair) for pair in pairwise(log)):
        yield "two consecutive positions are farther apart than the speeds allow"
    for direction, distance_m, limit_m in (
        ("high", max(moment.up_m for moment in log), plan.highest_m + POSITION_ERROR_M),
        ("away", max(moment.distance_m for moment in log), plan.farthest_m + POSITION_ERROR_M),
    ):
        if distance_m > limit_m:
            allowed_m = limit_m - POSITION_ERROR_M
            yield f"the drone was {distance_m:.1f} m {direction}, but the plan allows {allowed_m:.1f} m"
    if (speed_m_s := max(moment.speed_m_s for moment in log)) > _SPEED_SHARE * plan.fastest_m_s + _SPEED_M_S:
        yield f"the drone flew at {speed_m_s:.1f} m/s, but its limit is {plan.fastest_m_s:g} m/s"


def telemetry_contradiction(log: Sequence[FlightMoment], places_m: Floats) -> str | None:
    """Return the reason why telemetry and the log cannot be from the same flight.

    None if they can, or if the telemetry has no positions.

    Args:
        log: The log.
        places_m: Positions in the telemetry of the same autopilot during the flight: metres along two horizontal
            axes, and up. Shape (n, 3).
    """
    if not len(places_m):
        return None
    log_m = np.array([(moment.ahead_m, moment.left_m, moment.up_m) for moment in log])
    for direction, axes in (("over the ground", slice(0, 2)), ("in height", slice(2, 3))):
        telemetry_m, logged_m = (
            float(np.linalg.norm(np.ptp(positions_m[:, axes], axis=0))) for positions_m in (places_m, log_m)
        )
        # The axes of the two bounding boxes differ: east and north in telemetry, ahead and left in the log.
        # A rotation changes the diagonal by a factor of up to sqrt(2).
        if telemetry_m > math.sqrt(2) * logged_m + POSITION_ERROR_M:
            return f"moved {telemetry_m:.1f} m {direction} in its telemetry, but only {logged_m:.1f} m in its log"
    return None


def _jumps(before: FlightMoment, after: FlightMoment) -> bool:
    distance_m = math.dist((before.ahead_m, before.left_m, before.up_m), (after.ahead_m, after.left_m, after.up_m))
    speed_m_s = max(before.speed_m_s, after.speed_m_s)
    return distance_m > POSITION_ERROR_M + (_SPEED_SHARE * speed_m_s + _SPEED_M_S) * (after.at_s - before.at_s)
