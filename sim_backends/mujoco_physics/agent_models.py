"""Limits and models of agents in MuJoCo at the start of a run."""

import math
from collections.abc import Mapping
from typing import Any

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.handshake import AgentStart
from sim_backends.mujoco_physics.chassis import chassis
from sim_backends.mujoco_physics.mjcf import RobotModel, quaternion
from sim_backends.physics.differential_drive import slope_tilt_rad
from sim_backends.physics.ground import Ground
from sim_backends.physics.robot_limits import BODIES, TURTLEBOT3_BURGER, DriveLimits, QuadrotorLimits, quadrotor
from sim_backends.world.world import World


def agent_limits(agent: AgentStart, body: Mapping[str, Any] | None) -> DriveLimits | QuadrotorLimits:
    """Return the limits of an agent: the limits in the configuration, otherwise the built-in limits of its profile.

    A ground robot with neither has the limits of a TurtleBot3 Burger, a drone those of the Duckiedrone.

    Raises:
        ConfigurationError: The configuration has limits of another kind of robot.
    """
    if body is not None:
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in body.items()
        }
        try:
            return QuadrotorLimits(**values) if agent.flies else DriveLimits(**values)
        except TypeError as error:
            raise ConfigurationError(
                f"the body of {agent.name} is invalid: {error}", remedy="use the configuration of a scenario"
            ) from error
    if agent.flies:
        return quadrotor(agent.profile)
    built_in_limits = BODIES.get(agent.profile)
    return built_in_limits if isinstance(built_in_limits, DriveLimits) else TURTLEBOT3_BURGER


def agent_model(agent: AgentStart, limits: DriveLimits | QuadrotorLimits, world: World | None) -> RobotModel:
    """Return the model of an agent at its start; a robot on wheels is tilted like the ground below it."""
    e, n, u = agent.start.position_m
    place_m, heading_rad = (e, n, u - agent.antenna_m), agent.start.heading_rad or 0.0
    if isinstance(limits, QuadrotorLimits):
        return RobotModel(place_m, quaternion(heading_rad), agent.antenna_m, 0.0, limits)
    roll_rad, pitch_rad = slope_tilt_rad(Ground(world, math.inf).surface(e, n).grade, heading_rad)
    orientation = quaternion(heading_rad, pitch_rad, roll_rad)
    return RobotModel(place_m, orientation, agent.antenna_m, limits.friction, chassis(agent.profile, limits))
