"""Sections of robot profiles for robots that move automatically: `drive` for ground robots, `mavlink` for drones."""

from collections.abc import Iterable
from typing import Annotated, Final

from typing_extensions import override

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import ProfileSection, RobotProfile, TopicName
from fieldkit.config.schema import Duration, Field, Fraction, Int, Number, pattern_field
from fieldkit.motion import permissions

DRIVE: Final = "drive"
MAVLINK: Final = "mavlink"

MIN_CHARGE: Final = 0.2
"""Default minimum charge for the start of a flight. Battery manufacturers recommend a reserve of 20 %."""

TWIST: Final = "geometry_msgs/Twist"
TWIST_STAMPED: Final = "geometry_msgs/TwistStamped"

BASE_FRAME: Final = "base_link"
"""Frame of a mobile base (REP 105)."""

_CONNECTION: Final = r"^((udpout|udpin|tcp):[0-9A-Za-z.-]+:[0-9]{1,5}|/dev/[0-9A-Za-z/_.-]+:[0-9]{3,7})$"


BOOT_S: Final = 2.0
"""Boot time of an emulated autopilot; a real one takes about 30 s."""


class Mavlink(ProfileSection):
    """The robot's autopilot, if it has one; an emulated robot has an [emulated autopilot](emulated-autopilot.md).

    Attributes:
        port: UDP port on which the autopilot listens on the radio.
        connection: Connection from the robot's computer, for the step `mavlink`: `udpout:HOST:PORT` (sends first),
            `udpin:HOST:PORT`, `tcp:HOST:PORT` or `/dev/ttyAMA0:921600`; by default UDP `port` of the robot itself.
        autopilot: Firmware of an emulated autopilot: `px4` or `ardupilot`. A real autopilot reports its firmware.
        system: System id of an emulated autopilot after power-on, 1 to 250.
        boot_s: Time from power-on until the position estimate of an emulated autopilot has an origin, 0 to 120 s; a
            real one takes about 30 s.
        least_charge: Minimum battery charge required before a flight.
    """

    permission = permissions.MOVE

    port: Annotated[Int, Field(gt=0, lt=65536)]
    connection: (
        Annotated[
            str, pattern_field(_CONNECTION, "a connection, such as udpout:127.0.0.1:14550 or /dev/ttyAMA0:921600")
        ]
        | None
    ) = None
    autopilot: Annotated[str, Field(pattern="^(px4|ardupilot)$", exclude_if=lambda name: name == "px4")] = "px4"
    system: Annotated[Int, Field(gt=0, le=250, exclude_if=lambda number: number == 1)] = 1
    boot_s: Annotated[Number | Int, Field(ge=0, le=120, exclude_if=lambda time_s: time_s == BOOT_S)] = BOOT_S
    least_charge: Annotated[Fraction, Field(exclude_if=lambda share: share == MIN_CHARGE)] = MIN_CHARGE

    @property
    def onboard_connection(self) -> str:
        """The connection from the robot's computer."""
        return self.connection or f"udpout:127.0.0.1:{self.port}"


class Drive(ProfileSection):
    """Settings for [driving](motion.md) a ground robot automatically; without them, a person moves the robot.

    Attributes:
        topic: Topic of velocities that its base subscribes to.
        type: Type of this topic: `geometry_msgs/Twist`, or `geometry_msgs/TwistStamped`, the default of the
            controllers of ROS 2 Jazzy. Stamps are from the robot's clock.
        frame: Frame id of stamped velocities.
        odometry: Topic of its odometry (`nav_msgs/Odometry`).
        turn_rad_s: Maximum turn rate, in radians per second.
        acceleration_m_s2: Maximum acceleration, in m/s^2.
        lease: The robot stops if it has received nothing from the laptop for this time, 0.5 to 30 s.
    """

    permission = permissions.MOVE
    placement = "let {robot} face away from {other} with a clear path: it drives automatically"

    topic: TopicName = "/cmd_vel"
    type: Annotated[str, Field(pattern=f"^({TWIST}|{TWIST_STAMPED})$", exclude_if=lambda name: name == TWIST)] = TWIST
    frame: Annotated[
        str,
        pattern_field("^[A-Za-z0-9_/-]{1,100}$", "the name of a frame, such as base_link"),
        Field(exclude_if=lambda name: name == BASE_FRAME),
    ] = BASE_FRAME
    odometry: TopicName = "/odom"
    turn_rad_s: Annotated[Number | Int, Field(gt=0, le=10)] = 1.0
    acceleration_m_s2: Annotated[Number | Int, Field(gt=0, le=10)] = 0.5
    lease: Annotated[Duration, Field(ge=0.5, le=30)] = 2.0

    @override
    def contradiction(self, profile: RobotProfile) -> str | None:
        return "a robot with drive needs a fence; set limits.fence_m" if profile.limits.fence_m is None else None

    def topic_conflict(self, robot: Robot, others: Iterable[Robot]) -> str | None:
        """Return the reason why a robot cannot be driven by this section next to other robots; None if it can.

        Robots that share a ROS master or a ROS 2 domain receive each other's topics. No other robot may subscribe to
        the robot's velocity topic or publish its odometry topic.

        Args:
            robot: The robot.
            others: The robots that take part; may contain `robot`.
        """
        for other in others:
            if other.name == robot.name or not robot.ros_graph or other.ros_graph != robot.ros_graph:
                continue
            other_drive, other_ros = drive_of(other.profile), other.profile.ros
            if other_drive is not None and other_drive.topic == self.topic:
                return f"{other.name} also subscribes to {self.topic} of {robot.ros_graph} and would drive, too"
            if other_ros is not None and self.odometry in {topic.name for topic in other_ros.topics}:
                return f"{other.name} also publishes {self.odometry} of {robot.ros_graph}: the odometry is ambiguous"
        return None


def drive_of(profile: RobotProfile) -> Drive | None:
    """Return the section `drive` of a profile, or None if it has no such section."""
    return profile.section(DRIVE, Drive)


def mavlink_of(profile: RobotProfile) -> Mavlink | None:
    """Return the section `mavlink` of a profile, or None if it has no such section."""
    return profile.section(MAVLINK, Mavlink)


def can_drive(robot: Robot) -> bool:
    """Return True if steps that move the robot may drive it by the velocity topic of its profile."""
    return DRIVE in robot.abilities


def can_fly(robot: Robot) -> bool:
    """Return True if a step may fly the robot."""
    return MAVLINK in robot.abilities
