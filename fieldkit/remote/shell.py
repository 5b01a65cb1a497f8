"""The Shell protocol: runs commands on a robot, and fetches files."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fieldkit.core.deadline import Deadline


@dataclass(frozen=True)
class Completed:
    """The result of a remote command.

    Attributes:
        argv: The command.
        exit_code: Its exit code.
        stdout: Its complete standard output; empty after `Shell.fetch`.
        stderr: The end of its standard error, at most 64 KiB.
    """

    argv: tuple[str, ...]
    exit_code: int
    stdout: bytes
    stderr: bytes


class Session(Protocol):
    """A running remote command. The connection is silent until `end` is called or the command writes output."""

    @property
    def is_ready(self) -> bool:
        """Whether the command wrote as many bytes as `Shell.begin` waited for; False if it ended earlier.

        True if `Shell.begin` waited for no output.
        """
        ...

    def end(self, *, deadline: Deadline, check: bool = True) -> Completed:
        """Close the command's standard input, if it is open, and wait for its end; both streams are read.

        Args:
            deadline: Time limit.
            check: Whether to raise if the exit code is not 0.

        Raises:
            LinkError: The connection broke, or the deadline passed.
            RobotError: The exit code is not 0 and `check` is set; the message has the end of stderr.
        """
        ...


class Shell(Protocol):
    """A connection to one robot, which is reopened automatically after a loss.

    Every command must be idempotent. After a loss of the link the progress of a command is unknown, so a Shell may
    reconnect and send the same command again, also during `Session.end`. A command that only takes too long is not
    sent again.

    Each method that opens the connection raises a `RobotError` if the robot refuses the login or its host key has
    changed, and a `ConfigurationError` if there is no key for the login.
    """

    @property
    def robot(self) -> str:
        """Name of the robot, for messages."""
        ...

    @property
    def ssh_destination(self) -> str:
        """The arguments for `ssh` to this robot."""
        ...

    def begin(self, argv: Sequence[str], *, deadline: Deadline, until: bytes | None = None) -> Session:
        """Start a command and return when the robot has accepted it.

        Args:
            argv: Argument list; the Shell quotes it.
            deadline: Time limit.
            until: Return when the command has written this output, or has ended. The robot then reports the end of
                the command without a request. If it is None, the end is reported only when `Session.end` requests it.

        Raises:
            LinkError: The robot could not be reached, or the deadline passed.
        """
        ...

    def run(self, argv: Sequence[str], *, deadline: Deadline, stdin: bytes = b"", check: bool = True) -> Completed:
        """Run a command and wait for its end; both streams are read.

        Args:
            argv: Argument list; the Shell quotes it.
            deadline: Time limit.
            stdin: Standard input of the command.
            check: Whether to raise if the exit code is not 0.

        Raises:
            LinkError: The robot could not be reached, the connection broke, or the deadline passed.
            RobotError: The exit code is not 0 and `check` is set; the message has the end of stderr. Or a signal
                terminated the command, or it wrote too much output.
        """
        ...

    def fetch(self, argv: Sequence[str], to: Path, *, deadline: Deadline, limit_bytes: int) -> Completed:
        """Run a command and write its standard output to the file `to` (`stdout` of the result is empty).

        Raises:
            LinkError: For the same reasons as `run`.
            OSError: The file cannot be written, for example because the disk of this computer is full.
            RobotError: The exit code is not 0, or there is more output than `limit_bytes`.
        """
        ...

    def silence(self, seconds: float) -> AbstractContextManager[None]:
        """Keep the connection silent during the body, if it crosses the radio under test.

        A connection that is lost during the body is reopened after it, or after `seconds` if the body waits for the
        connection. The time limit for reopening starts at that time. Data of running commands are not affected.
        """
        ...

    def close(self) -> None:
        """Close the connection, and end all waits for it in other threads; commands on the robot continue."""
        ...
