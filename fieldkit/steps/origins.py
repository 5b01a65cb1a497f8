"""Origins of robots that move automatically, and the record of their motions: the interface for steps."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from fieldkit.core.model import MotionOrigin, Role


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
        """Record that the motion ended as planned; `at` is as the attribute."""
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
            OSError: The disk is full or gone. The robot must not move.
        """
        ...

    def refuse(self, role: Role, why: str) -> None:
        """Record that a robot refused to start because it is not at its start position.

        Then no robot moves until a person confirms.

        Raises:
            OSError: As `record`.
        """
        ...

    def moving(self, role: Role) -> AbstractContextManager[RobotMotion]:
        """Record that a robot moves while the body runs. The record is on disk before the body begins.

        Unless the body calls `RobotMotion.mark_ended`, no robot moves again before a person has confirmed. The call
        is missing after a fault, and after this process was killed within the body.

        Raises:
            MotionHeldError: A fault stopped a robot earlier, and no person has confirmed since.
            OSError: As `record`.
        """
        ...


class MemoryOrigins:
    """Origins of the robots of a lab that puts them back to their places; kept in memory, without confirmations."""

    robots_stay = False
    may_return = False

    def __init__(self) -> None:
        self._origins: dict[Role, MotionOrigin] = {}

    def get(self, role: Role) -> MotionOrigin | None:
        """Return the origin of a robot; None before its first start at this place."""
        return self._origins.get(role)

    def last(self, role: Role) -> MotionOrigin | None:  # noqa: ARG002 (the lab has moved the robot since)
        """Return None: the lab has put the robot back to its place."""
        return None

    def record(self, role: Role, origin: MotionOrigin) -> None:
        """Record the origin of a robot in memory."""
        self._origins[role] = origin

    def refuse(self, role: Role, why: str) -> None:
        """Do nothing: no confirmation is needed in a lab."""

    @contextmanager
    def moving(self, role: Role) -> Iterator[RobotMotion]:  # noqa: ARG002 (nothing is recorded)
        """Yield a motion that is not recorded."""
        yield RobotMotion()
