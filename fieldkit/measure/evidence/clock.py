"""A robot's clock before and after an attempt, beside its seconds since boot: has it been set meanwhile?

Linux slews its clock and the time since boot together: what NTP corrects by frequency, by tick or bit by bit, at up
to 500 ppm or chrony's 8.3 %, moves both alike (clock_gettime(2)). Their difference changes only where the clock is
set: settimeofday(2), ADJ_SETOFFSET of adjtimex(2), a leap second. So a step is what has changed in it.

A state file has lines `BEFORE TIME AFTER`: the clock between two readings of /proc/uptime, which cuts off to 10 ms.
Each line bounds the difference from both sides, however long the robot took to read; together they bound it closer.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

_READING: Final = re.compile(r"(\d{1,12})\.(\d{2}) (\d{1,11})(?:\.(\d{9}))? (\d{1,12})\.(\d{2})", re.ASCII)

_TICK_NS: Final = 10_000_000
_SECOND_NS: Final = 1_000_000_000


@dataclass(frozen=True)
class Clock:
    """A robot's clock at one moment, by one or more readings; nanoseconds since 1970 UTC.

    Attributes:
        first_ns: The earliest that the clock can have shown at these readings.
        last_ns: The latest.
        lowest_ns: The least that it can be ahead of the time since boot.
        highest_ns: The most; below `lowest_ns` where it was set between two readings.
    """

    first_ns: int
    last_ns: int
    lowest_ns: int
    highest_ns: int


@dataclass(frozen=True)
class ClockStep:
    """How far a clock was set between two moments of one boot.

    Attributes:
        step_s: The best estimate, in seconds; negative where it was set back.
        error_s: The most that the estimate can be wrong.
    """

    step_s: float
    error_s: float


def parse(lines: Iterable[str]) -> Clock | None:
    """Return what readings say of a clock, None where there is no reading; other lines are passed over."""
    readings = [_bounds(match) for line in lines if (match := _READING.fullmatch(line))]
    if not readings:
        return None
    first, last, lowest, highest = zip(*readings, strict=True)
    return Clock(min(first), max(last), max(lowest), min(highest))


def _bounds(match: re.Match[str]) -> tuple[int, int, int, int]:
    """Return the least and the most that the clock showed, and that it was ahead of the time since boot."""
    before_ns, after_ns = (int(match[at]) * _SECOND_NS + int(match[at + 1]) * _TICK_NS for at in (1, 5))
    first_ns = int(match[3]) * _SECOND_NS + int(match[4] or 0)
    # A clock that tells whole seconds may have been up to one further.
    last_ns = first_ns if match[4] else first_ns + _SECOND_NS
    return first_ns, last_ns, first_ns - after_ns - _TICK_NS, last_ns - before_ns


def moved(before: Clock, after: Clock) -> ClockStep:
    """Return how far a clock was set between two moments of one boot."""
    least_ns, most_ns = after.lowest_ns - before.highest_ns, after.highest_ns - before.lowest_ns
    return ClockStep((least_ns + most_ns) / 2e9, (most_ns - least_ns) / 2e9)


def problem(before: Clock, after: Clock) -> str | None:
    """Return how a clock was set between two moments of one boot; None where it was not, as far as they can tell."""
    if any(moment.lowest_ns > moment.highest_ns for moment in (before, after)):
        return "its clock was set while it was read"
    step = moved(before, after)
    if abs(step.step_s) <= step.error_s:
        return None
    where = "back" if step.step_s < 0 else "ahead"
    return f"its clock was set {where} by {abs(step.step_s):.3f} s (known to {step.error_s:.3f} s) during the repeat"
