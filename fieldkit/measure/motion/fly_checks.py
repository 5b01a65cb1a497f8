"""Contradictions in the log of a flight: with itself, with what was asked for, with the attempt, with telemetry."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Floats
from fieldkit.measure.motion.fly_log import PHASES, FlightMoment
from fieldkit.measure.motion.motion_log import time_contradictions

PLACE_M: Final = 5.0
"""An autopilot's estimate of its place may be off, or jump, by as much: satellites under open sky, 95 % of cases."""

_SPEED_SHARE: Final = 1.5
_SPEED_M_S: Final = 2.0
"""Wind, overshoot, and a landing that the autopilot leads."""


@dataclass(frozen=True)
class FlyPlan:
    """What a drone was asked to fly.

    Attributes:
        highest_m: How high at most.
        farthest_m: How far over the ground from where it rose.
        fastest_m_s: How fast at most, its limit.
        window: Its computer's clock before and after the attempt, nanoseconds since 1970 UTC; None if not known.
    """

    highest_m: float
    farthest_m: float
    fastest_m_s: float
    window: tuple[int, int] | None


def contradictions(log: Sequence[FlightMoment], plan: FlyPlan) -> Iterator[str]:
    """Yield what cannot be true of a flight that ended well, a sentence each."""
    ranks = [PHASES.index(moment.phase) for moment in log]
    if ranks != sorted(ranks):
        yield "its phases are not in the order of a flight"
    if log[-1].phase != PHASES[-1]:
        yield f"ends while the drone was {log[-1].phase}, not {PHASES[-1]}"
    yield from time_contradictions(log, plan.window)
    if any(_jumps(*pair) for pair in pairwise(log)):
        yield "a place is farther from the one before it than its speeds explain"
    for what, value, most in (
        ("high", max(moment.up_m for moment in log), plan.highest_m + PLACE_M),
        ("away", max(moment.off_m for moment in log), plan.farthest_m + PLACE_M),
    ):
        if value > most:
            yield f"the drone was {value:.1f} m {what}, and was to be {most - PLACE_M:.1f} m at most"
    if (speed_m_s := max(moment.speed_m_s for moment in log)) > _SPEED_SHARE * plan.fastest_m_s + _SPEED_M_S:
        yield f"the drone flew at {speed_m_s:.1f} m/s, and its limit is {plan.fastest_m_s:g} m/s"


def of_telemetry(log: Sequence[FlightMoment], places_m: Floats) -> str | None:
    """Return why telemetry is of another flight than the log; None if both may be of one.

    Args:
        log: The log.
        places_m: Places that the same autopilot told meanwhile, along three axes. Shape (n, 3).
    """
    if not len(places_m):
        return None
    own_m = np.array([(moment.ahead_m, moment.left_m, moment.up_m) for moment in log])
    for what, axes in (("over the ground", slice(0, 2)), ("in height", slice(2, 3))):
        told_m, logged_m = (float(np.linalg.norm(np.ptp(of[:, axes], axis=0))) for of in (places_m, own_m))
        # The box around a way is larger by up to the square root of 2 if its axes point elsewhere.
        if told_m > math.sqrt(2) * logged_m + PLACE_M:
            return f"its telemetry moved {told_m:.1f} m {what}, and its log says {logged_m:.1f} m"
    return None


def _jumps(before: FlightMoment, after: FlightMoment) -> bool:
    way_m = math.dist((before.ahead_m, before.left_m, before.up_m), (after.ahead_m, after.left_m, after.up_m))
    speed_m_s = max(before.speed_m_s, after.speed_m_s)
    return way_m > PLACE_M + (_SPEED_SHARE * speed_m_s + _SPEED_M_S) * (after.at_s - before.at_s)
