"""Origins of robots that move by themselves, and what became of each of their motions, as steps use them."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol

from fieldkit.core.model import MotionOrigin, Role


class RobotMotion:
    """A motion in progress.

    Attributes:
        at: Where the robot stopped, in the frame of its origin; None if it did not report it.
        is_over: Whether `ended` was called.
    """

    def __init__(self) -> None:
        self.at: MotionOrigin | None = None
        self.is_over = False

    def ended(self, at: MotionOrigin | None = None) -> None:
        """Enter that the motion ended as it was to end; `at` is as the attribute."""
        self.at, self.is_over = at, True


class Origins(Protocol):
    """Origins of the robots of a trial, by role.

    Attributes:
        kept: Whether robots stay where a motion left them: real robots do. Robots of a lab that puts them back to
            their places after each motion do not.
        may_return: Whether a ground robot that is not at its place, but within its fence, may drive back to it.
    """

    @property
    def kept(self) -> bool:
        """See the class."""
        ...

    @property
    def may_return(self) -> bool:
        """See the class."""
        ...

    def get(self, role: Role) -> MotionOrigin | None:
        """Return the origin of a robot; None before its first start at this place."""
        ...

    def last(self, role: Role) -> MotionOrigin | None:
        """Return where the last motion of a robot ended, in the frame of its origin; None if unknown."""
        ...

    def record(self, role: Role, origin: MotionOrigin) -> None:
        """Record the origin of a robot; it is on disk when this returns.

        Raises:
            OSError: The disk is full or gone. The robot must not move.
        """
        ...

    def refuse(self, role: Role, why: str) -> None:
        """Record that a robot did not start, because it is not where it must be.

        No robot moves then before a person confirms it.

        Raises:
            OSError: As `record`.
        """
        ...

    def moving(self, role: Role) -> AbstractContextManager[RobotMotion]:
        """Record that a robot moves while the body runs. The record is on disk before the body begins.

        Unless the body calls `RobotMotion.ended`, no robot moves again before a person has confirmed it. After a
        fault the body ends without that call; it also counts as a fault if this process ends within the body.

        Raises:
            MotionHeldError: A fault stopped a robot earlier, and nobody has confirmed since.
            OSError: As `record`.
        """
        ...


class MemoryOrigins:
    """Origins of the robots of a lab, which puts them back to their places: nothing is on disk, nothing is held."""

    kept = False
    may_return = False

    def __init__(self) -> None:
        self._origins: dict[Role, MotionOrigin] = {}

    def get(self, role: Role) -> MotionOrigin | None:
        """See `Origins.get`."""
        return self._origins.get(role)

    def last(self, role: Role) -> MotionOrigin | None:  # noqa: ARG002 (the lab has moved it since)
        """See `Origins.last`."""
        return None

    def record(self, role: Role, origin: MotionOrigin) -> None:
        """See `Origins.record`."""
        self._origins[role] = origin

    def refuse(self, role: Role, why: str) -> None:
        """See `Origins.refuse`."""

    @contextmanager
    def moving(self, role: Role) -> Iterator[RobotMotion]:  # noqa: ARG002 (nothing is held)
        """See `Origins.moving`."""
        yield RobotMotion()
