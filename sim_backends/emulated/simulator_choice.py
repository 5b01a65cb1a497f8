"""A lab's choice of simulators and sync policy: defaults, requirements, and a check before a run."""

import inspect
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import RobotProfile
from fieldkit.core.errors import ConfigurationError
from fieldkit.lab.robots import LabRobot
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.policies.window_policies import FixedWindow
from sim_backends.emulated.cosimulated.simulators import BUILTIN, KINEMATIC, RobotBody, Simulators
from sim_backends.emulated.emulated_options import EmulatedOptions, SyncOptions
from sim_backends.emulated.motion_sections import drive_of, mavlink_of
from sim_backends.federates.frames import NETWORK, PHYSICS
from sim_backends.federates.named import (
    ProgramFederate,
    PythonFederate,
    command_line,
    default_options,
    named_federate,
)
from sim_backends.physics.robot_limits import BODIES, TURTLEBOT3_BURGER, DriveLimits, quadrotor

_EXTERNAL_NETWORK = SyncOptions.model_validate({"name": "sliding_window", "window": "2ms"})
"""Default sync policy for a network simulator in another process.

An exchange at every event of the network would be too slow for real time, because ns-3 has about 14 events per packet
and an exchange takes 0.2 ms.
"""

GAZEBO: Final = "gazebo"
_EXTERNAL_PHYSICS = SyncOptions.model_validate({"name": "sliding_window", "window": "10ms"})
"""Default sync policy for Gazebo. An exchange at every physics step (1 ms) would be too slow for real time."""


def sync_of(options: EmulatedOptions) -> SyncOptions:
    """Return the sync policy of a lab."""
    if options.sync is not None:
        return options.sync
    if options.physics == GAZEBO:
        return _EXTERNAL_PHYSICS
    return SyncOptions.defaults() if options.network in {None, BUILTIN} else _EXTERNAL_NETWORK


def resolve(options: EmulatedOptions) -> Simulators:
    """Return the simulators of a lab; programs are compiled if necessary.

    Raises:
        ConfigurationError: A simulator is not installed or does not support the lab, or the policy is invalid.
    """
    sync = sync_of(options)
    policy = make_policy(sync.name, **sync.parameters)
    if isinstance(policy, FixedWindow) and sync.window < sync.step:
        raise ConfigurationError(
            f"emulated.sync has a window of {sync.window:g} s, which is shorter than the physics step, "
            f"{sync.step:g} s",
            remedy=f"write window: {sync.step * 1e3:g}ms, or a shorter step",
        )
    network_options = default_options(options.network or BUILTIN, NETWORK)
    physics_options = _gazebo_options() if options.physics == GAZEBO else None
    return Simulators(_physics(options), _network(options), sync.step_ns, network_options, physics_options)


def _physics(options: EmulatedOptions) -> str:
    """Return the name of the physics simulator, or its command line if it is a separate program."""
    name = options.physics or KINEMATIC
    if name == KINEMATIC:
        return name
    federate = named_federate(name, PHYSICS)
    if isinstance(federate, ProgramFederate):
        return federate.command()
    if isinstance(federate, PythonFederate):
        federate.load()
    return name


def _gazebo_options() -> dict[str, Any]:
    """Return the options of Gazebo, with its partition and address from the environment.

    The medium process does not inherit these environment variables, so it receives them as options. Velocities are
    means over a window, because the velocities over the last step of a window would need a second request.
    """
    set_options = {
        option: os.environ.get(f"GZ_{variable}") or os.environ.get(f"IGN_{variable}")
        for option, variable in (("partition", "PARTITION"), ("ip", "IP"))
    }
    return (
        default_options(GAZEBO, PHYSICS)
        | {"velocity": "window"}
        | {option: value for option, value in set_options.items() if value}
    )


def _network(options: EmulatedOptions) -> str:
    """Return `builtin`, or the command line of the network simulator."""
    name = options.network or BUILTIN
    if name == BUILTIN:
        return name
    return command_line(name, NETWORK)


def bodies_of(robots: Iterable[Robot | LabRobot]) -> dict[str, RobotBody]:
    """Return the bodies of robots, by name."""
    return {robot.name: _body(robot.profile) for robot in robots}


def _body(profile: RobotProfile) -> RobotBody:
    """Return the body of a robot with this profile, and its limits of motion.

    A ground robot whose body is unknown has the body of a TurtleBot3. The maximum speed of a ground robot is that of
    its profile; so are its acceleration and turn rate, if the profile has the section `drive`. A drone has the limits
    of its airframe, because its autopilot enforces the limits in the profile.
    """
    if mavlink_of(profile) is not None:
        return RobotBody(profile.name, quadrotor(profile.name))
    body = BODIES.get(profile.name)
    limits = body if isinstance(body, DriveLimits) else TURTLEBOT3_BURGER
    limits = replace(limits, speed_m_s=float(profile.limits.max_speed_m_s))
    if (drive := drive_of(profile)) is not None:
        limits = replace(limits, acceleration_m_s2=drive.acceleration_m_s2, turn_rad_s=drive.turn_rad_s)
    return RobotBody(profile.name, limits)


def summary(options: EmulatedOptions) -> Mapping[str, str]:
    """Return texts for `physics`, `network`, `sync` (the policy) and `step` (of the physics simulator) of a lab."""
    sync = sync_of(options)
    policy = make_policy(sync.name, **sync.parameters)
    values = sync.parameters
    # A name ends with its unit: `window_s` is shown as `window 0.002 s`.
    names_and_units = {name: name.rsplit("_", 1) for name in inspect.signature(type(policy)).parameters}
    parameter_texts = [
        f"{text} {values[name]:g} {unit}" for name, (text, unit) in names_and_units.items() if name in values
    ]
    return {
        "physics": options.physics or KINEMATIC,
        "network": options.network or BUILTIN,
        "sync": ", ".join([sync.name, *parameter_texts]),
        "step": f"{sync.step:g} s",
    }
