"""The programs that steer a scenario's agents."""

import math
from collections.abc import Mapping
from typing import Any, Final

from fieldkit.core.model import Vector
from sim_backends.cosim.federates import Program
from sim_backends.cosim.programs.beats import PERIOD_NS
from sim_backends.cosim.programs.follow import FollowAtHeadway, HoldStation
from sim_backends.cosim.programs.velocity_profile import ProfileLeg, VelocityProfile
from sim_backends.cosim.programs.way_points import DriveThrough, FlyThrough
from sim_backends.cosim.scenario.motions import (
    FollowPlan,
    LegPlan,
    StandingPlan,
    StationKeepingPlan,
    VelocityProfilePlan,
    WayPointsPlan,
)
from sim_backends.cosim.scenario.schema import AgentPlan, CosimScenario
from sim_backends.physics.body import Body, Twist, Velocity
from sim_backends.radio.random_streams import RandomStream

STATION_M_S: Final = 1.0
"""Largest speed at which an agent returns to its station."""


def stops(bodies: Mapping[str, Body[Any]]) -> dict[str, Twist | Velocity]:
    """Return the command that stops each body."""
    return {name: Velocity() if body.flies else Twist() for name, body in bodies.items()}


def controllers(scenario: CosimScenario, bodies: Mapping[str, Body[Any]], seed: int) -> dict[str, Program]:
    """Return the controller of each agent; an agent that does not move has none.

    Args:
        scenario: The scenario.
        bodies: The body of each agent.
        seed: Seed of the phases that the scenario does not set; controllers of different robots are not synchronous.
    """
    programs = {
        name: _controller(plan, bodies[name], _phase_ns(name, plan, seed)) for name, plan in scenario.agents.items()
    }
    return {name: program for name, program in programs.items() if program is not None}


def _phase_ns(name: str, plan: AgentPlan, seed: int) -> int:
    if plan.phase is not None:
        return round(plan.phase * 1e9)
    return int(RandomStream(seed, name, "controller's phase").draw(0) * PERIOD_NS)


def _controller(plan: AgentPlan, body: Body[Any], phase_ns: int) -> Program | None:
    motion = plan.motion
    match motion:
        case StandingPlan():
            return None
        case WayPointsPlan():
            begin_ns = round(motion.wait * 1e9) + phase_ns
            return _through(path_points_m(motion, body.place_m), motion.speed, body, begin_ns)
        case StationKeepingPlan():
            return _through([body.place_m], STATION_M_S, body, phase_ns)
        case VelocityProfilePlan():
            heading_rad = math.radians(plan.heading_deg)
            return VelocityProfile([_leg(leg, body, heading_rad) for leg in motion.legs])
        case FollowPlan():
            return _follower(motion, body, phase_ns)


def _leg(leg: LegPlan, body: Body[Any], heading_rad: float) -> ProfileLeg:
    command: Twist | Velocity = Twist(leg.speed, math.radians(leg.turn_deg_s))
    if body.flies:
        east, north = leg.speed * math.cos(heading_rad), leg.speed * math.sin(heading_rad)
        command = Velocity((east, north, float(leg.climb_m_s)))
    return ProfileLeg(round(leg.duration * 1e9), command)


def _follower(motion: FollowPlan, body: Body[Any], begin_ns: int) -> Program:
    timeout_ns = round(motion.timeout * 1e9)
    if body.flies:
        return HoldStation(motion.leader, above_m=motion.distance, timeout_ns=timeout_ns, begin_ns=begin_ns)
    (leader,) = motion.leader
    return FollowAtHeadway(
        leader,
        headway_s=motion.headway,
        standstill_m=motion.distance,
        top_speed_m_s=body.top_speed_m_s,
        timeout_ns=timeout_ns,
        begin_ns=begin_ns,
    )


def _through(points_m: list[Vector], speed_m_s: float, body: Body[Any], begin_ns: int) -> Program:
    if body.flies:
        return FlyThrough(points_m, speed_m_s, begin_ns=begin_ns)
    return DriveThrough([(east_m, north_m) for east_m, north_m, _ in points_m], speed_m_s, begin_ns=begin_ns)


def path_points_m(plan: WayPointsPlan, start_m: Vector) -> list[Vector]:
    """Return the waypoints of a path, metres east, north, up."""
    origin_m = start_m if plan.relative else (0.0, 0.0, 0.0)
    return [
        (origin_m[0] + east_m, origin_m[1] + north_m, origin_m[2] + up_m[0] if up_m else start_m[2])
        for east_m, north_m, *up_m in plan.points_m
    ]
