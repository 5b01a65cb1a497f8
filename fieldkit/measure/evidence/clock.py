"""Detection of steps of a robot's clock between two readings, by comparison with the time since boot.

Linux slews the clock and the time since boot together, so gradual corrections by NTP (up to 500 ppm, or 8.3 % by
chrony) change both equally (clock_gettime(2)). Their difference changes only if the clock is set: by settimeofday(2),
ADJ_SETOFFSET of adjtimex(2), or a leap second. A change of the difference is therefore a clock step.

A state file has lines `BEFORE TIME AFTER`: a reading of the clock between two readings of /proc/uptime, which is
truncated to 10 ms. Each line gives a lower and an upper bound of the difference, however long the readings took.
Several lines give closer bounds.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

_READING: Final = re.compile(r"(\d{1,12})\.(\d{2}) (\d{1,11})(?:\.(\d{9}))? (\d{1,12})\.(\d{2})", re.ASCII)

_TICK_NS: Final = 10_000_000  # resolution of /proc/uptime
_SECOND_NS: Final = 1_000_000_000


@dataclass(frozen=True)
class Clock:
    """Bounds of a robot's clock from one or more readings; nanoseconds since 1970 UTC.

    Attributes:
        first_ns: Earliest possible time of the clock at these readings.
        last_ns: Latest possible time.
        lowest_ns: Lower bound of the clock minus the time since boot.
        highest_ns: Upper bound of this difference; it is below `lowest_ns` if the clock was set between two readings.
    """

    first_ns: int
    last_ns: int
    lowest_ns: int
    highest_ns: int


@dataclass(frozen=True)
class ClockStep:
    """Step of a clock between two readings without a reboot between them.

    Attributes:
        step_s: Estimated step in seconds; negative if the clock was set back.
        error_s: Largest possible error of the estimate, in seconds.
    """

    step_s: float
    error_s: float


def parse(lines: Iterable[str]) -> Clock | None:
    """Return the bounds of a clock from the lines that are readings, or None if there are no readings."""
    readings = [_bounds(match) for line in lines if (match := _READING.fullmatch(line))]
    if not readings:
        return None
    first, last, lowest, highest = zip(*readings, strict=True)
    return Clock(min(first), max(last), max(lowest), min(highest))


def _bounds(match: re.Match[str]) -> tuple[int, int, int, int]:
    """Return `first_ns`, `last_ns`, `lowest_ns` and `highest_ns` of one reading (see `Clock`)."""
    before_ns, after_ns = (int(match[group]) * _SECOND_NS + int(match[group + 1]) * _TICK_NS for group in (1, 5))
    first_ns = int(match[3]) * _SECOND_NS + int(match[4] or 0)
    # A clock reading in whole seconds is truncated by up to one second.
    last_ns = first_ns if match[4] else first_ns + _SECOND_NS
    return first_ns, last_ns, first_ns - after_ns - _TICK_NS, last_ns - before_ns


def clock_step(before: Clock, after: Clock) -> ClockStep:
    """Return the step of a clock between two readings without a reboot between them."""
    min_step_ns, max_step_ns = after.lowest_ns - before.highest_ns, after.highest_ns - before.lowest_ns
    return ClockStep((min_step_ns + max_step_ns) / 2e9, (max_step_ns - min_step_ns) / 2e9)


def step_description(before: Clock, after: Clock) -> str | None:
    """Return a description of a clock step between two readings, or None if no step can be detected.

    The robot must not have been rebooted between the readings.
    """
    if any(reading.lowest_ns > reading.highest_ns for reading in (before, after)):
        return "its clock was set while it was read"
    step = clock_step(before, after)
    if abs(step.step_s) <= step.error_s:
        return None
    direction = "back" if step.step_s < 0 else "ahead"
    uncertainty = f"(uncertainty {step.error_s:.3f} s)"
    return f"its clock was set {direction} by {abs(step.step_s):.3f} s {uncertainty} during the repeat"
