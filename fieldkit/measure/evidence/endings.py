"""Ends of an attempt's jobs on a robot, as it noted them: by themselves, at their limit, or by fieldkit."""

import re
import signal
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

_ENDING: Final = re.compile(
    r"(?P<name>[A-Za-z0-9._-]{1,60}) (?P<how>itself|asked|limit|running) (?P<code>\d{1,3}|-) "
    r"(?P<started>\d{1,15}) (?P<ended>\d{1,12}\.\d{2}|-)",
    re.ASCII,
)

_TICKS_PER_S: Final = 100
"""Of field 22 of /proc/PID/stat, on every processor but Alpha and Itanium (USER_HZ)."""

_KILLED: Final = 128
"""A shell adds it to the number of the signal that ended a command."""

_SLACK_S: Final = 0.1
"""What the two clocks of a job's start and end, in 10 ms both, and its own start can take off."""


class Cause(StrEnum):
    """Cause of a job's end."""

    ITSELF = "itself"
    ASKED = "asked"
    LIMIT = "limit"
    RUNNING = "running"
    """Nobody yet, when its robot was asked."""


_NOT_ALLOWED: Final = {
    Cause.ITSELF: "ended before fieldkit ended it, with exit code {}",
    Cause.ASKED: "was ended by fieldkit before it was done",
    Cause.LIMIT: "did not end by itself, and was ended at its limit",
}


@dataclass(frozen=True)
class Ending:
    """How a job ended.

    Attributes:
        cause: Who ended it; whoever sends a signal on the robot, past fieldkit, makes it end by itself.
        code: Its exit code; None where it was killed together with what watched over it.
        lasted_s: How long it ran, in seconds; None where nobody saw its end.
        ended_s: When it ended, in seconds since boot; None if that is unknown.
    """

    cause: Cause
    code: int | None
    lasted_s: float | None
    ended_s: float | None = None


def parse(lines: Iterable[str]) -> Mapping[str, Ending]:
    """Return the endings by name of the job; lines that tell none are passed over."""
    return {match["name"]: _ending(match) for line in lines if (match := _ENDING.fullmatch(line))}


def times_s(lines: Iterable[str]) -> Mapping[str, tuple[float, float | None]]:
    """Return when each job started and ended, in seconds since boot; the end is None if that is unknown."""
    matches = [match for line in lines if (match := _ENDING.fullmatch(line))]
    started_s = {match["name"]: int(match["started"]) / _TICKS_PER_S for match in matches}
    ended_s = {match["name"]: None if match["ended"] == "-" else float(match["ended"]) for match in matches}
    return {name: (at_s, ended_s[name]) for name, at_s in started_s.items()}


def _ending(match: re.Match[str]) -> Ending:
    ended_s = None if match["ended"] == "-" else float(match["ended"])
    lasted_s = None if ended_s is None else ended_s - int(match["started"]) / _TICKS_PER_S
    return Ending(Cause(match["how"]), None if match["code"] == "-" else int(match["code"]), lasted_s, ended_s)


def problem(ending: Ending, allowed: Collection[Cause], least_s: float = 0.0) -> str | None:
    """Return why a job did not end as it is to, without its name; None where it did.

    Args:
        ending: How it ended.
        allowed: Who may end it.
        least_s: How long it runs at least where nothing cuts it short, in seconds.
    """
    if ending.code is None:
        return "still ran when the evidence was collected" if ending.cause is Cause.RUNNING else "was killed"
    if ending.cause not in allowed:
        return _NOT_ALLOWED[ending.cause].format(ending.code)
    if ending.cause is Cause.ITSELF and ending.code > _KILLED:
        return f"was ended by {_signal(ending.code - _KILLED)}, not by fieldkit"
    if ending.cause is Cause.ITSELF and ending.lasted_s is not None and ending.lasted_s + _SLACK_S < least_s:
        return f"ended after {ending.lasted_s:.1f} s of {least_s:g} s"
    return None


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
