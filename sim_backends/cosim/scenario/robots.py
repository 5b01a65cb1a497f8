"""What an agent's robot is: its body, and its radio."""

import math
from dataclasses import replace
from typing import Any

from fieldkit.config import profiles
from fieldkit.config.locations import names
from fieldkit.core.model import Vector
from sim_backends.cosim.scenario.schema import AgentPlan, CosimScenario
from sim_backends.physics.body import Body
from sim_backends.physics.differential_drive import TURTLEBOT3_BURGER, DifferentialDrive, DriveLimits
from sim_backends.physics.known import BODIES, quadrotor
from sim_backends.physics.quadrotor import Quadrotor, QuadrotorLimits
from sim_backends.radio.world_channel import Antenna, antenna_of
from sim_backends.world.world import World


def robots() -> list[str]:
    """Return every name that an agent's `robot` may have: kinds of bodies, and profiles of robots."""
    return sorted({*BODIES, *names("robots")})


def limits(robot: str) -> DriveLimits | QuadrotorLimits:
    """Return what a robot's body can do.

    A profile that is no kind of body has that of the paper's robot of its kind, at the speed that it says.
    """
    if robot in BODIES:
        return BODIES[robot]
    profile = profiles.load_profile(robot)
    like: DriveLimits | QuadrotorLimits = quadrotor(robot) if profile.kind == "uav" else TURTLEBOT3_BURGER
    return replace(like, speed_m_s=float(profile.limits.max_speed_m_s))


def bodies(scenario: CosimScenario, world: World) -> dict[str, Body[Any]]:
    """Return the bodies of all agents, where they start."""
    return {name: _body(plan, scenario, world) for name, plan in scenario.agents.items()}


def _body(plan: AgentPlan, scenario: CosimScenario, world: World) -> Body[Any]:
    heading_rad, can = math.radians(plan.heading_deg), limits(plan.robot)
    east_m, north_m, up_m = _start_m(plan, scenario, world)
    if isinstance(can, QuadrotorLimits):
        return Quadrotor(can, (east_m, north_m, up_m), heading_rad)
    return DifferentialDrive(can, (east_m, north_m), heading_rad)


def _start_m(plan: AgentPlan, scenario: CosimScenario, world: World) -> Vector:
    """Return where an agent starts: metres east, north, up."""
    place_m = plan.at_m
    if place_m is None:
        assert plan.along is not None
        place_m = world.lines[scenario.line].at(plan.along, plan.aside_m)
    return *place_m, world.ground_m(place_m) + plan.height


def antennas(scenario: CosimScenario) -> dict[str, Antenna]:
    """Return the antennas of those agents that have a radio: their own, or that of their robot profile."""
    known = names("robots")
    used = {plan.robot for plan in scenario.agents.values() if plan.radio is None and plan.robot in known}
    of_profiles = {robot: antenna_of(profiles.load_profile(robot).radio) for robot in sorted(used)}
    found = {}
    for name, plan in scenario.agents.items():
        if (own := plan.radio) is not None:
            found[name] = Antenna(own.standard, float(own.tx_power_dbm), float(own.sensitivity_dbm))
        elif plan.robot in of_profiles:
            found[name] = of_profiles[plan.robot]
    return found
