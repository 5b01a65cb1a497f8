"""Conflicts of ROS topics between a robot that drives itself and other robots that receive the same topics."""

from collections.abc import Iterable

from fieldkit.backends.protocols import Robot


def topic_conflict(robot: Robot, others: Iterable[Robot]) -> str | None:
    """Return the reason why a robot with `drive` in its profile cannot be driven next to others; None if it can.

    Robots that share a ROS master or a ROS 2 domain receive each other's topics. No other robot may subscribe to the
    robot's velocity topic or publish its odometry topic.

    Args:
        robot: The robot.
        others: The robots that take part; may contain `robot`.
    """
    drive = robot.profile.drive
    for other in others:
        if drive is None or other.name == robot.name or not robot.ros_graph or other.ros_graph != robot.ros_graph:
            continue
        other_drive, other_ros = other.profile.drive, other.profile.ros
        if other_drive is not None and other_drive.topic == drive.topic:
            return f"{other.name} also subscribes to {drive.topic} of {robot.ros_graph} and would drive, too"
        if other_ros is not None and drive.odometry in {topic.name for topic in other_ros.topics}:
            return f"{other.name} also publishes {drive.odometry} of {robot.ros_graph}: the odometry is ambiguous"
    return None
