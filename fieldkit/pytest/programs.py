"""Programs on robots: what became of one, and one that runs while a test does something else."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

# The inner shell becomes the program, which so has SIGINT as who types Ctrl-C sends it; it comes when our end of
# standard input closes, also where that is because we are gone. The outer one has an exit code whatever ends that.
_UNTIL_CLOSED: Final = (
    'exec 3<&0; { cat <&3 >/dev/null; kill -INT "$$"; sleep 2; kill -TERM "$$"; sleep 2; kill -KILL "$$"; } '
    '>/dev/null 2>&1 & exec "$@" 3<&- </dev/null'
)
_RUNNING: Final = ("sh", "-c", 'sh -c "$@"; exit "$?"', "sh", _UNTIL_CLOSED, "sh")


class ProgramError(AssertionError):
    """A program on a robot did not do what the test wants of it: the test fails, the lab is well."""


@dataclass(frozen=True)
class ProgramOutput:
    """What became of a program on a robot.

    Attributes:
        argv: The program with its arguments.
        exit_code: Its exit code.
        stdout: What it printed; bytes that are no UTF-8 are replaced.
        stderr: What it printed on standard error.
    """

    argv: tuple[str, ...]
    exit_code: int
    stdout: str
    stderr: str


class RunningProgram:
    """A program that runs on a robot.

    Attributes:
        output: What became of it, once it has ended.
    """

    def __init__(self) -> None:
        self.output: ProgramOutput | None = None


def until_closed(argv: Sequence[str]) -> tuple[str, ...]:
    """Return the command that runs a program until the command's standard input is closed.

    The program gets SIGINT then, and SIGTERM and SIGKILL two and four seconds later if it goes on.
    """
    return (*_RUNNING, *argv)
