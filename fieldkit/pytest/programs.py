"""Programs on robots: the result of one, and one that runs during a test."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

# The inner shell becomes the program, which therefore receives SIGINT as from Ctrl-C. The signal is sent when our end
# of standard input closes, also because this process was killed. The outer shell returns an exit code in any case.
_UNTIL_CLOSED: Final = (
    'exec 3<&0; { cat <&3 >/dev/null; kill -INT "$$"; sleep 2; kill -TERM "$$"; sleep 2; kill -KILL "$$"; } '
    '>/dev/null 2>&1 & exec "$@" 3<&- </dev/null'
)
_RUNNING: Final = ("sh", "-c", 'sh -c "$@"; exit "$?"', "sh", _UNTIL_CLOSED, "sh")


class ProgramError(AssertionError):
    """A program on a robot did not do what the test requires: the test fails, but the lab works."""


@dataclass(frozen=True)
class ProgramOutput:
    """The result of a program on a robot.

    Attributes:
        argv: The program with its arguments.
        exit_code: Its exit code.
        stdout: Its output; bytes that are not UTF-8 are replaced.
        stderr: Its output on standard error.
    """

    argv: tuple[str, ...]
    exit_code: int
    stdout: str
    stderr: str


class RunningProgram:
    """A program that runs on a robot.

    Attributes:
        output: Its result after it has exited, None before.
    """

    def __init__(self) -> None:
        self.output: ProgramOutput | None = None


def until_closed(argv: Sequence[str]) -> tuple[str, ...]:
    """Return the command that runs a program until the command's standard input is closed.

    The program then receives SIGINT, and SIGTERM and SIGKILL two and four seconds later if it continues.
    """
    return (*_RUNNING, *argv)
