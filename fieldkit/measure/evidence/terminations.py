"""Terminations of an attempt's jobs as recorded on the robot: cause, exit code and duration."""

import re
import signal
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

_TERMINATION: Final = re.compile(
    r"(?P<name>[A-Za-z0-9._-]{1,60}) (?P<how>itself|asked|limit|running) (?P<code>\d{1,3}|-) "
    r"(?P<started>\d{1,15}) (?P<ended>\d{1,12}\.\d{2}|-)",
    re.ASCII,
)

_TICKS_PER_S: Final = 100
"""Clock ticks per second of field 22 of /proc/PID/stat (USER_HZ), on every processor except Alpha and Itanium."""

_KILLED: Final = 128
"""A shell's exit code for a command that was killed by a signal is this number plus the signal number."""

_TOLERANCE_S: Final = 0.1
"""Tolerance of a job's duration: both times have a resolution of 10 ms, and the program of the job needs time to
start."""


class Cause(StrEnum):
    """Cause of a job's termination: it exited, fieldkit stopped it, or its time limit was reached."""

    EXITED = "itself"
    STOPPED = "asked"
    LIMIT = "limit"
    RUNNING = "running"
    """The job was still running when its state was recorded."""


_NOT_ALLOWED: Final = {
    Cause.EXITED: "exited before fieldkit stopped it, with exit code {}",
    Cause.STOPPED: "was stopped by fieldkit before it had finished",
    Cause.LIMIT: "did not exit, and was stopped at its time limit",
}


@dataclass(frozen=True)
class Termination:
    """Termination of a job.

    Attributes:
        cause: Cause of the termination; `EXITED` includes a signal that was not sent by fieldkit.
        code: Exit code; None if the job was killed together with its supervisor, or is still running.
        duration_s: Duration in seconds; None if the end is unknown.
        ended_s: End, in seconds since boot; None if unknown.
    """

    cause: Cause
    code: int | None
    duration_s: float | None
    ended_s: float | None = None


def parse(lines: Iterable[str]) -> Mapping[str, Termination]:
    """Return the terminations by the names of the jobs; other lines are ignored."""
    return {match["name"]: _termination(match) for line in lines if (match := _TERMINATION.fullmatch(line))}


def times_s(lines: Iterable[str]) -> Mapping[str, tuple[float, float | None]]:
    """Return start and end of each job in seconds since boot, by name; the end is None if unknown."""
    matches = [match for line in lines if (match := _TERMINATION.fullmatch(line))]
    started_s = {match["name"]: int(match["started"]) / _TICKS_PER_S for match in matches}
    ended_s = {match["name"]: None if match["ended"] == "-" else float(match["ended"]) for match in matches}
    return {name: (start_s, ended_s[name]) for name, start_s in started_s.items()}


def _termination(match: re.Match[str]) -> Termination:
    ended_s = None if match["ended"] == "-" else float(match["ended"])
    duration_s = None if ended_s is None else ended_s - int(match["started"]) / _TICKS_PER_S
    return Termination(Cause(match["how"]), None if match["code"] == "-" else int(match["code"]), duration_s, ended_s)


def termination_error(
    termination: Termination, allowed: Collection[Cause], min_duration_s: float = 0.0
) -> str | None:
    """Return the reason why the termination of a job is not acceptable, or None if it is.

    The reason does not contain the job's name.

    Args:
        termination: The termination.
        allowed: Acceptable causes.
        min_duration_s: Minimum duration of a job that exits without being stopped, in seconds.
    """
    if termination.cause is Cause.RUNNING:
        return "was still running when the evidence was collected"
    if termination.code is None:
        return "was killed"
    if termination.cause not in allowed:
        return _NOT_ALLOWED[termination.cause].format(termination.code)
    if termination.cause is Cause.EXITED and termination.code > _KILLED:
        return f"was killed by {_signal(termination.code - _KILLED)}, not by fieldkit"
    if (
        termination.cause is Cause.EXITED
        and termination.duration_s is not None
        and termination.duration_s + _TOLERANCE_S < min_duration_s
    ):
        return f"exited after {termination.duration_s:.1f} s instead of {min_duration_s:g} s"
    return None


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
