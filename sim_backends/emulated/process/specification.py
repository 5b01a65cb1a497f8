"""What each robot of a cast is told about itself."""

from collections.abc import Mapping
from ipaddress import IPv4Network
from typing import Final, TypeVar

from fieldkit.backends.protocols import Robot
from fieldkit.lab.protocol import Member
from sim_backends.emulated.options import AS_THIS_MACHINE, RobotOptions, RosChoice
from sim_backends.emulated.process.definitions import definition
from sim_backends.emulated.process.keys import KeyPair
from sim_backends.emulated.robot.spec import RobotSpec, Sensor

NETWORK: Final = IPv4Network("10.42.0.0/24")
LAPTOP: Final = NETWORK[-2]
"""Address of the laptop; the robots have those before it."""


Key = TypeVar("Key")
"""What tells robots apart: a role in a trial, a name in a playground."""


def sensors_of(robots: Mapping[Key, Robot | Member], key: Key) -> tuple[Sensor, ...]:
    """Return what a robot publishes."""
    topics = robots[key].profile.ros.topics
    return tuple(Sensor(one.name, one.type, one.rate, one.frame, one.points) for one in topics)


def specification(
    robots: Mapping[Key, Robot | Member],
    key: Key,
    *,
    ros: RosChoice,
    login: KeyPair,
    host_key: KeyPair,
    tools: RobotOptions = AS_THIS_MACHINE,
) -> RobotSpec:
    """Return what a robot is told about itself."""
    robot = robots[key]
    command = robot.profile.ros.command
    ros2 = robot.profile.ros.variant == "ros2"
    sensors = sensors_of(robots, key)
    return RobotSpec(
        name=robot.name,
        interface=robot.profile.radio.interface,
        address=f"{robot.address}/{NETWORK.prefixlen}",
        hosts={one.name: one.address for one in robots.values()},
        host_key=host_key.private,
        authorized_key=login.public,
        # Debian has no ROS 2.
        ros=(RosChoice.BUILTIN if ros2 else ros).value,
        ros_version=2 if ros2 else 1,
        distribution=command.distribution,
        setup=command.setup,
        sensors=sensors,
        definitions={sensor.type: definition(sensor.type) for sensor in sensors},
        **tools.model_dump(),
    )
