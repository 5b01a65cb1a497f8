"""Speeds that a scenario asks for, and what bodies can do: what is beyond it is refused, as it would be clipped."""

import math
from collections.abc import Iterator
from itertools import pairwise

from fieldkit.config.schema import Location
from fieldkit.core.model import Vector
from sim_backends.cosim.scenario.motions import LegPlan, VelocityProfilePlan, WayPointsPlan
from sim_backends.cosim.scenario.steering import way_m
from sim_backends.physics.differential_drive import DriveLimits
from sim_backends.physics.quadrotor import QuadrotorLimits

Limits = DriveLimits | QuadrotorLimits
Asked = tuple[Location, str, float, float, str]
"""Keys that lead to it, what it is, how much is asked for, the most that the body can do, and the unit."""

_SAME = 1e-9


def beyond_limits(motion: object, start_m: Vector, can: Limits) -> Iterator[Asked]:
    """Yield what a motion asks for and a body cannot do.

    Args:
        motion: What an agent does, as its scenario says.
        start_m: Where it starts, metres east, north, up.
        can: The limits of its body.
    """
    for asked in _asked(motion, start_m, can):
        if asked[2] > asked[3] * (1 + _SAME):
            yield asked


def _asked(motion: object, start_m: Vector, can: Limits) -> Iterator[Asked]:
    if isinstance(motion, WayPointsPlan):
        yield ("speed",), "a speed", motion.speed, can.speed_m_s, "m/s"
        if isinstance(can, QuadrotorLimits):
            yield from _climbs(motion, start_m, can)
    elif isinstance(motion, VelocityProfilePlan):
        for number, leg in enumerate(motion.legs):
            for place, what, asked, most, unit in _of_leg(leg, can):
                yield ("legs", number, *place), what, asked, most, unit


def _of_leg(leg: LegPlan, can: Limits) -> Iterator[Asked]:
    yield ("speed",), "a speed", abs(leg.speed), can.speed_m_s, "m/s"
    if isinstance(can, QuadrotorLimits):
        yield ("climb_m_s",), *_climb(float(leg.climb_m_s), can)
    else:
        most_deg_s = math.degrees(can.turn_rad_s)
        yield ("turn_deg_s",), "a rate of turn", abs(float(leg.turn_deg_s)), most_deg_s, "deg/s"


def _climbs(motion: WayPointsPlan, start_m: Vector, can: QuadrotorLimits) -> Iterator[Asked]:
    for here_m, there_m in pairwise([start_m, *way_m(motion, start_m)]):
        length_m = math.dist(here_m, there_m)
        if length_m:
            yield ("speed",), *_climb(motion.speed * (there_m[2] - here_m[2]) / length_m, can)


def _climb(up_m_s: float, can: QuadrotorLimits) -> tuple[str, float, float, str]:
    down_m_s, most_m_s = can.climb_m_s
    if up_m_s < 0:
        return "a sink rate", -up_m_s, down_m_s, "m/s"
    return "a climb rate", up_m_s, most_m_s, "m/s"
