"""Conditions for driving a robot by its topic: nobody else obeys it, and nobody else says where the robot is."""

from collections.abc import Iterable

from fieldkit.backends.protocols import Robot


def disturbed(robot: Robot, others: Iterable[Robot]) -> str | None:
    """Return why a robot with `drive` in its profile cannot be driven among others; None where it can.

    Robots that share a ROS master, or a domain of ROS 2, hear each other's topics.

    Args:
        robot: The robot.
        others: Robots that take part, which may be it, too.
    """
    own = robot.profile.drive
    for other in others:
        if own is None or other.name == robot.name or not robot.ros_graph or other.ros_graph != robot.ros_graph:
            continue
        theirs, ros = other.profile.drive, other.profile.ros
        if theirs is not None and theirs.topic == own.topic:
            return f"{other.name} listens to {own.topic} of {robot.ros_graph} too, and would drive as well"
        if ros is not None and own.odometry in {topic.name for topic in ros.topics}:
            return (
                f"{other.name} publishes {own.odometry} of {robot.ros_graph} too: whose odometry it is nobody knows"
            )
    return None
