"""Speeds in a scenario that exceed the limits of a body; they are refused, because the body would clip them."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

from fieldkit.config.schema import Location
from fieldkit.core.model import Vector
from sim_backends.cosim.scenario.motions import LegPlan, VelocityProfilePlan, WayPointsPlan
from sim_backends.cosim.scenario.steering import path_points_m
from sim_backends.physics.differential_drive import DriveLimits
from sim_backends.physics.quadrotor import QuadrotorLimits

Limits = DriveLimits | QuadrotorLimits


class Demand(NamedTuple):
    """A speed or rate that a motion requires, and the limit of the body.

    Attributes:
        location: Keys of the value.
        quantity: Name of the quantity, with its article.
        value: The required value.
        limit: The largest value that the body reaches.
        unit: Unit of both.
    """

    location: Location
    quantity: str
    value: float
    limit: float
    unit: str


_ROUNDING = 1e-9


def excesses(motion: object, start_m: Vector, limits: Limits) -> Iterator[Demand]:
    """Yield the demands of a motion that exceed the limits of a body.

    Args:
        motion: The motion of an agent in its scenario.
        start_m: Its start position, metres east, north, up.
        limits: The limits of its body.
    """
    for demand in _demands(motion, start_m, limits):
        if demand.value > demand.limit * (1 + _ROUNDING):
            yield demand


def _demands(motion: object, start_m: Vector, limits: Limits) -> Iterator[Demand]:
    if isinstance(motion, WayPointsPlan):
        yield Demand(("speed",), "a speed", motion.speed, limits.speed_m_s, "m/s")
        if isinstance(limits, QuadrotorLimits):
            yield from _climbs(motion, start_m, limits)
    elif isinstance(motion, VelocityProfilePlan):
        for number, leg in enumerate(motion.legs):
            for demand in _leg_demands(leg, limits):
                yield demand._replace(location=("legs", number, *demand.location))


def _leg_demands(leg: LegPlan, limits: Limits) -> Iterator[Demand]:
    yield Demand(("speed",), "a speed", abs(leg.speed), limits.speed_m_s, "m/s")
    turn_deg_s = abs(float(leg.turn_deg_s))
    if isinstance(limits, QuadrotorLimits):
        yield _climb(("climb_m_s",), float(leg.climb_m_s), limits)
        yield Demand(("turn_deg_s",), "a rate of turn", turn_deg_s, 0.0, "deg/s")  # it keeps its heading
    else:
        yield Demand(("turn_deg_s",), "a rate of turn", turn_deg_s, math.degrees(limits.turn_rad_s), "deg/s")
        yield Demand(("climb_m_s",), "a climb rate", abs(float(leg.climb_m_s)), 0.0, "m/s")


def _climbs(motion: WayPointsPlan, start_m: Vector, limits: QuadrotorLimits) -> Iterator[Demand]:
    for here_m, there_m in pairwise([start_m, *path_points_m(motion, start_m)]):
        length_m = math.dist(here_m, there_m)
        if length_m:
            yield _climb(("speed",), motion.speed * (there_m[2] - here_m[2]) / length_m, limits)


def _climb(location: Location, up_m_s: float, limits: QuadrotorLimits) -> Demand:
    down_limit_m_s, up_limit_m_s = limits.climb_m_s
    if up_m_s < 0:
        return Demand(location, "a sink rate", -up_m_s, down_limit_m_s, "m/s")
    return Demand(location, "a climb rate", up_m_s, up_limit_m_s, "m/s")
