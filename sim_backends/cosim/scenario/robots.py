"""The robots of agents: their bodies and their radios."""

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
    """Return all valid values of an agent's `robot`: kinds of bodies, and names of robot profiles."""
    return sorted({*BODIES, *names("robots")})


def limits(robot: str) -> DriveLimits | QuadrotorLimits:
    """Return the limits of a robot's body.

    A robot profile that is not a kind of body has the body of the paper's robot of its kind, with its own top speed.
    """
    if robot in BODIES:
        return BODIES[robot]
    profile = profiles.load_profile(robot)
    similar: DriveLimits | QuadrotorLimits = quadrotor(robot) if profile.kind == "uav" else TURTLEBOT3_BURGER
    return replace(similar, speed_m_s=float(profile.limits.max_speed_m_s))


def bodies(scenario: CosimScenario, world: World) -> dict[str, Body[Any]]:
    """Return the bodies of all agents, at their start positions."""
    return {name: _body(plan, scenario, world) for name, plan in scenario.agents.items()}


def _body(plan: AgentPlan, scenario: CosimScenario, world: World) -> Body[Any]:
    heading_rad, body_limits = math.radians(plan.heading_deg), limits(plan.robot)
    east_m, north_m, up_m = _start_m(plan, scenario, world)
    if isinstance(body_limits, QuadrotorLimits):
        return Quadrotor(body_limits, (east_m, north_m, up_m), heading_rad)
    return DifferentialDrive(body_limits, (east_m, north_m), heading_rad)


def _start_m(plan: AgentPlan, scenario: CosimScenario, world: World) -> Vector:
    """Return the start position of an agent: metres east, north, up."""
    place_m = plan.at_m
    if place_m is None:
        assert plan.along is not None
        place_m = world.lines[scenario.line].at(plan.along, plan.aside_m)
    return *place_m, world.ground_m(place_m) + plan.height


def antennas(scenario: CosimScenario) -> dict[str, Antenna]:
    """Return the antennas of the agents that have a radio, from their plan or from their robot profile."""
    profile_names = names("robots")
    used = {plan.robot for plan in scenario.agents.values() if plan.radio is None and plan.robot in profile_names}
    profile_antennas = {robot: antenna_of(profiles.load_profile(robot).radio) for robot in sorted(used)}
    agent_antennas = {}
    for name, plan in scenario.agents.items():
        if (radio := plan.radio) is not None:
            agent_antennas[name] = Antenna(radio.standard, float(radio.tx_power_dbm), float(radio.sensitivity_dbm))
        elif plan.robot in profile_antennas:
            agent_antennas[name] = profile_antennas[plan.robot]
    return agent_antennas
