"""Checks whether an emulated lab supports the robots of a site file, their profiles, and the options of the lab."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import Ros
from fieldkit.config.schema import Document
from fieldkit.config.site import Site
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Control
from sim_backends.emulated.emulated_options import EmulatedOptions, Ros2Options, RosChoice
from sim_backends.emulated.provisioning import LAPTOP_NAME, RobotKey, sensors_of
from sim_backends.emulated.robot.spec import unsupported_paths
from sim_backends.emulated.ros import sensor_specs

if TYPE_CHECKING:
    from fieldkit.lab.robots import LabRobot  # not needed for a trial


def check_site(site: Site, document: Document | None, options: EmulatedOptions, addresses: int) -> None:
    """Raise ConfigurationError if the options of a lab conflict with its robots.

    Args:
        site: The site file.
        document: Its document, for line numbers; None without a site file.
        options: The options of the lab.
        addresses: Number of addresses for robots.
    """
    if len(site.robots) > addresses:
        raise ConfigurationError(
            f"the lab has {len(site.robots)} robots, but an emulated lab has addresses for {addresses}",
            where=document.where(("robots",)) if document else "",
            remedy="split the site file",
        )
    for name in options.robots:
        if name not in site.robots:
            raise ConfigurationError(
                f"emulated.robots names {name!r}, which the lab does not have",
                where=document.where(("emulated", "robots", name)) if document else "",
                remedy=did_you_mean(name, site.robots, f"the robots are: {', '.join(site.robots)}"),
            )
    router = options.ros2.router
    if router is not None and router not in site.robots:
        raise ConfigurationError(
            f"emulated.ros2.router names {router!r}, which the lab does not have",
            where=document.where(("emulated", "ros2", "router")) if document else "",
            remedy=did_you_mean(router, site.robots, f"the robots are: {', '.join(site.robots)}"),
        )
    if site.control is Control.RADIO and LAPTOP_NAME in site.robots:
        raise ConfigurationError(
            f"with control: radio, the name {LAPTOP_NAME!r} is reserved for the operator's laptop",
            where=document.where(("robots", LAPTOP_NAME)) if document else "",
            remedy="give the robot another name",
        )
    if site.control is Control.RADIO and options.has_linux_wifi:
        raise ConfigurationError(
            "with `wifi: linux`, the operator's laptop has no radio",
            where=document.where(("control",)) if document else "",
            remedy="remove control: radio",
        )


def check_infrastructure(
    names: Iterable[str], options: EmulatedOptions, document: Document | None, *, has_relay: bool
) -> None:
    """Raise ConfigurationError if the access points or neighbours in the options conflict with the robots."""
    if not options.radio.has_infrastructure:
        return
    from sim_backends.radio.infrastructure import infrastructure  # noqa: PLC0415 (only some labs use it)

    if problem := infrastructure.conflict(options.radio, [*names], has_relay=has_relay):
        raise ConfigurationError(
            problem,
            where=document.where(("emulated", "radio")) if document else "",
            remedy="change emulated.radio in the site file",
        )


def check_profiles(robots: "Mapping[RobotKey, Robot | LabRobot]", options: EmulatedOptions) -> None:
    """Raise ConfigurationError if the lab does not support the ROS settings or a sensor of a profile."""
    for robot in robots.values():
        _check_ros(robot, options)
        for sensor in sensors_of(robot):
            sensor_specs.check(sensor)


def _check_ros(robot: "Robot | LabRobot", options: EmulatedOptions) -> None:
    """Raise ConfigurationError if the lab does not support the ROS settings of a profile."""
    ros = robot.profile.ros
    if ros is None:
        return
    if ros.variant == "ros2":
        _check_ros2(robot.name, ros, options.ros2)
    if ros.variant == "ros2" and options.ros is RosChoice.DEBIAN:
        raise ConfigurationError(
            f"profile {robot.profile.name} runs ros2, but the site file requests Debian's ROS, which is ROS 1",
            where=robot.name,
            remedy="write ros: auto, or set variant: ros1 in a copy of the profile",
        )
    if ros.variant == "ros2" and any(topic.definition for topic in ros.topics):
        raise ConfigurationError(
            f"profile {robot.profile.name} runs ros2, whose emulated recorder supports only standard types",
            where=robot.name,
            remedy="remove the topics that have a definition from a copy of the profile",
        )
    if unsupported := unsupported_paths(ros.command.setup):
        raise ConfigurationError(
            f"a robot cannot have the setup file {unsupported[0]}: it is in the root directory or in a kernel folder",
            where=robot.name,
            remedy="move it to another folder",
        )


def check_bridges(robots: "Mapping[RobotKey, Robot | LabRobot]", ros: RosChoice) -> None:
    """Raise ConfigurationError if a profile has a bridge from ROS 1 but the lab has no ROS master."""
    for robot in robots.values():
        if ros is RosChoice.BUILTIN and robot.profile.ros is not None and robot.profile.ros.bridge is not None:
            raise ConfigurationError(
                f"profile {robot.profile.name} has a bridge, which needs Debian's ROS",
                where=robot.name,
                remedy="apt-get install --no-install-recommends python3-rosmaster python3-rospy python3-rosbag "
                "python3-sensor-msgs; or remove bridge from a copy of the profile",
            )


def _check_ros2(name: str, ros: Ros, options: Ros2Options) -> None:
    """Raise ConfigurationError if the lab does not support the ROS 2 settings of a profile."""
    from fieldkit.ros.middlewares.ports import MAX_DOMAIN  # noqa: PLC0415 (other robots need no package for ROS)

    if options.discovery == "router" and ros.middleware != "zenoh":
        raise ConfigurationError(
            "emulated.ros2 has a router, but the profile uses DDS, which has no router",
            where=name,
            remedy="write rmw: zenoh in a copy of the profile, or discovery: peers in the site file",
        )
    if ros.domain > MAX_DOMAIN:
        raise ConfigurationError(
            f"the ports of ROS_DOMAIN_ID {ros.domain} of the profile are ephemeral ports of Linux, which any program "
            "may use",
            where=name,
            remedy=f"use a domain from 0 to {MAX_DOMAIN}",
        )
