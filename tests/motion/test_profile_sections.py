"""Conflicts of ROS topics between robots with the same or different ROS masters or domains."""

from collections.abc import Iterable

import pytest

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import RobotProfile
from fieldkit.motion.profile_sections import Drive, drive_of, mavlink_of
from sim_backends.emulated import motion_sections
from tests.helpers.casts import DUCKIEDRONE, TURTLEBOT, ros_of

MASTER = "10.42.0.3"


def robot(name: str, profile: RobotProfile = TURTLEBOT, master: str = "") -> Robot:
    return Robot(name=name, address="10.42.0.9", profile=profile, ros_master=master)


def drive_section(profile: RobotProfile) -> Drive:
    drive = drive_of(profile)
    assert drive is not None
    return drive


def conflict(robot: Robot, others: Iterable[Robot]) -> str | None:
    return drive_section(robot.profile).topic_conflict(robot, others)


def turtlebot(*, topic: str = "/cmd_vel", odometry: str = "/odom", domain: str | None = None) -> RobotProfile:
    """Return the profile of the TurtleBot with these topic names; with a domain it has ROS 2."""
    ros = ros_of(TURTLEBOT)
    topics = tuple(
        item.model_copy(update={"name": odometry}) if item.name == "/odom" else item for item in ros.topics
    )
    update: dict[str, object] = {"topics": topics}
    if domain is not None:
        update |= {"variant": "ros2", "environment": {"ROS_DOMAIN_ID": domain} if domain else {}}
    drive = drive_section(TURTLEBOT).model_copy(update={"topic": topic, "odometry": odometry})
    return TURTLEBOT.model_copy(update={"drive": drive, "ros": ros.model_copy(update=update)})


@pytest.mark.parametrize(
    ("other", "expected_reason"),
    [
        (robot("other"), None),
        (robot("other", master="10.42.0.4"), None),
        (robot("other", master=MASTER), "other also subscribes to /cmd_vel of the ROS master at 10.42.0.3"),
        (robot("other", turtlebot(topic="/other/cmd_vel"), MASTER), "other also publishes /odom of the ROS master"),
        (robot("other", turtlebot(topic="/other/cmd_vel", odometry="/other/odom"), MASTER), None),
        (robot("other", turtlebot(domain="0")), None),
        (robot("other", DUCKIEDRONE, MASTER), None),
        (robot("one", master=MASTER), None),
    ],
)
def test_conflicts_of_robots_with_the_same_master_are_reported(other: Robot, expected_reason: str | None) -> None:
    reason = conflict(robot("one", master=MASTER), [other])
    assert (
        reason == expected_reason
        if expected_reason is None
        else reason is not None and reason.startswith(expected_reason)
    )


@pytest.mark.parametrize(("domain", "is_valid"), [("", False), ("0", False), ("7", True)])
def test_conflicts_of_robots_with_the_same_ros2_domain_are_reported(domain: str, is_valid: bool) -> None:
    reason = conflict(robot("one", turtlebot(domain="")), [robot("other", turtlebot(domain=domain))])
    assert (reason is None) is is_valid
    assert is_valid or reason == "other also subscribes to /cmd_vel of ROS domain 0 and would drive, too"


def test_emulated_robots_implement_the_sections() -> None:
    drive: motion_sections.DriveSection | None = drive_of(TURTLEBOT)
    mavlink: motion_sections.MavlinkSection | None = mavlink_of(DUCKIEDRONE)
    assert drive is not None
    assert motion_sections.drive_of(TURTLEBOT) is drive
    assert mavlink is not None
    assert motion_sections.mavlink_of(DUCKIEDRONE) is mavlink


def test_robots_with_separate_masters_have_no_conflict() -> None:
    assert conflict(robot("one"), [robot("other")]) is None
