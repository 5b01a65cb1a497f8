"""The Shell protocol: how everything else runs commands on a robot and moves files."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fieldkit.core.deadline import Deadline


@dataclass(frozen=True)
class Completed:
    """A remote command that ended.

    Attributes:
        argv: The command.
        exit_code: Its exit code.
        stdout: All of its standard output.
        stderr: All of its standard error.
    """

    argv: tuple[str, ...]
    exit_code: int
    stdout: bytes
    stderr: bytes


class Session(Protocol):
    """A remote command that runs; nothing crosses the connection until `end`, or until it writes something."""

    @property
    def told(self) -> bool:
        """Whether the command wrote what `Shell.begin` waited for; false if it ended without."""
        ...

    def end(self, *, deadline: Deadline, check: bool = True) -> Completed:
        """Close the command's standard input, if it is open, and wait for its end; both streams are drained.

        Args:
            deadline: When to give up.
            check: Raise when the exit code is not 0.

        Raises:
            LinkError: The connection broke, or the deadline passed.
            RobotError: The exit code is not 0 and `check` is set; the message has the end of stderr.
        """
        ...


class Shell(Protocol):
    """A connection to one robot, which it makes again by itself when it was lost.

    Every command must be one that may be sent twice with the effect of once. When the link is lost nobody knows how
    far a command got, so a Shell may connect again and send the same words again, also in the middle of
    `Session.end`. A command that merely takes too long is not sent again.
    """

    @property
    def robot(self) -> str:
        """Name of the robot, for messages."""
        ...

    @property
    def by_hand(self) -> str:
        """What a person types after `ssh` to get there."""
        ...

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> Session:
        """Start a command and return when the robot has accepted it, which tells its end when `end` asks for it.

        Args:
            argv: Argument list; quoting is the Shell's work.
            deadline: When to give up.
            until: Return when the command has written this, or has ended; its end is told at once then, and asking
                for it sends nothing.

        Raises:
            LinkError: The robot could not be reached, or the deadline passed.
        """
        ...

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        """Run a command and wait for its end; both streams are drained.

        Args:
            argv: Argument list; quoting is the Shell's work.
            deadline: When to give up.
            stdin: Fed to the command, then closed.
            check: Raise when the exit code is not 0.

        Raises:
            LinkError: The robot could not be reached, the connection broke, or the deadline passed.
            RobotError: The exit code is not 0 and `check` is set; the message has the end of stderr.
        """
        ...

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        """Run a command and write its standard output to the file `to` (`stdout` of the result is empty).

        Raises:
            LinkError: As `run`.
            RobotError: The exit code is not 0, or there is more output than `limit_bytes`.
        """
        ...

    def silence(self, seconds: float) -> AbstractContextManager[None]:
        """Keep the connection silent while the body measures, where it crosses the radio under test.

        A connection that is lost meanwhile is made again after the body, or after `seconds` where the body waits for
        it: so long it is also awaited, and patience begins then. What the connection carries is not touched.
        """
        ...

    def close(self) -> None:
        """End the connection, and all waiting for it in other threads; what runs on the robot goes on."""
        ...
