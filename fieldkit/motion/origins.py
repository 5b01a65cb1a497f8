"""Interface for steps: origins of robots that drive or fly automatically, and records of their motions."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Protocol, cast

from fieldkit.core.model import Role
from fieldkit.steps.scene import Scene


@dataclass(frozen=True)
class MotionOrigin:
    """Position and heading of a robot.

    Those before its first start at a place are its origin there: the centre of its fence, and the reference of the
    directions of its paths.

    Attributes:
        frame: Frame of the coordinates: `odometry`, or `local` for MAVLink's LOCAL_POSITION_NED.
        frame_id: Identifies one instance of that frame, for example by the boot ID of the robot. It changes if the
            frame is lost and created again.
        x_m: x of `nav_msgs/Odometry`, or metres north.
        y_m: y of `nav_msgs/Odometry`, or metres east.
        heading_rad: Heading from x towards y: counterclockwise in `odometry`, clockwise in `local`.
        latitude_deg: Latitude (WGS 84); None if unknown.
        longitude_deg: Longitude (WGS 84); None if unknown.
    """

    frame: str
    frame_id: str
    x_m: float
    y_m: float
    heading_rad: float
    latitude_deg: float | None = None
    longitude_deg: float | None = None


class RobotMotion:
    """A motion in progress.

    Attributes:
        at: Pose at which the robot stopped, in the frame of its origin; None if it did not report one.
        is_over: Whether `mark_ended` was called.
    """

    def __init__(self) -> None:
        self.at: MotionOrigin | None = None
        self.is_over = False

    def mark_ended(self, at: MotionOrigin | None = None) -> None:
        """Record that the motion ended as planned, and at which pose the robot stopped."""
        self.at, self.is_over = at, True


class Origins(Protocol):
    """Origins of the robots of a trial, by role.

    Attributes:
        robots_stay: Whether robots stay where a motion ended, as real robots do. False if the lab puts them
            back to their places after each motion.
        may_return: Whether a ground robot that is not at its place but within its fence may drive back to its place.
    """

    @property
    def robots_stay(self) -> bool:
        """Whether robots stay where a motion ended."""
        ...

    @property
    def may_return(self) -> bool:
        """Whether a ground robot may drive back to its place."""
        ...

    def get(self, role: Role) -> MotionOrigin | None:
        """Return the origin of a robot; None before its first start at this place."""
        ...

    def last(self, role: Role) -> MotionOrigin | None:
        """Return the pose at which the last motion of a robot ended, in the frame of its origin; None if unknown."""
        ...

    def record(self, role: Role, origin: MotionOrigin) -> None:
        """Record the origin of a robot; it is on disk when this returns.

        Raises:
            OSError: The disk is full or was removed. The robot must not move.
        """
        ...

    def refuse(self, role: Role, reason: str) -> None:
        """Record that a robot refused to start because it is not at its start position.

        Then no robot moves until a person confirms, or the operator permits it by an option.

        Raises:
            OSError: For the same reasons as `record`.
        """
        ...

    def moving(self, role: Role) -> AbstractContextManager[RobotMotion]:
        """Record that a robot moves while the body runs. The record is on disk before the body begins.

        Unless the body calls `RobotMotion.mark_ended`, no robot moves again before a person has confirmed, or the
        operator has permitted it by an option. The body does not call it after a fault, or if this process is killed.

        Raises:
            MotionHeldError: A fault stopped a robot earlier, and no person has confirmed since.
            OSError: For the same reasons as `record`.
        """
        ...


class MemoryOrigins:
    """Origins in memory, for a lab that puts robots back to their places; no confirmations are needed."""

    robots_stay = False
    may_return = False

    def __init__(self) -> None:
        self._origins: dict[Role, MotionOrigin] = {}

    def get(self, role: Role) -> MotionOrigin | None:
        """Return the origin of a robot; None before its first start at this place."""
        return self._origins.get(role)

    def last(self, role: Role) -> MotionOrigin | None:  # noqa: ARG002 (the lab has moved the robot back)
        """Return None: the lab has put the robot back to its place."""
        return None

    def record(self, role: Role, origin: MotionOrigin) -> None:
        """Record the origin of a robot in memory."""
        self._origins[role] = origin

    def refuse(self, role: Role, reason: str) -> None:
        """Do nothing: no confirmation is needed in a lab."""

    @contextmanager
    def moving(self, role: Role) -> Iterator[RobotMotion]:  # noqa: ARG002 (nothing is recorded)
        """Yield a motion that is not recorded."""
        yield RobotMotion()


def origins_of(scene: Scene) -> Origins:
    """Return the origins of the robots of an attempt; without an attempt, as in a dry run, they are empty."""
    return MemoryOrigins() if scene.origins is None else cast("Origins", scene.origins)
