"""Reading and checks that logs of drives and of flights have in common: order of lines, agreement of two clocks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import reading

LONGEST_M: Final = 1e6
LONGEST_S: Final = 1e6
LAST_NS: Final = 2**62
"""Limits of valid values."""
_STALL_S: Final = 2.0
"""Longest suspension of the program by a busy robot between reading the two clocks of a line."""


class MotionMoment(Protocol):
    """A line of a log.

    Attributes:
        at_s: Time since the start of the program.
        utc_ns: Time by the robot's clock, nanoseconds since 1970 UTC; 0 if the line does not have it.
    """

    @property
    def at_s(self) -> float:
        """Time since the start of the program."""

    @property
    def utc_ns(self) -> int:
        """Time by the robot's clock."""


_Moment = TypeVar("_Moment", bound=MotionMoment)


def read(path: Path, parse: Callable[[Mapping[str, Any]], _Moment | None], motion: str) -> tuple[_Moment, ...]:
    """Return the lines of a log in the order of time; an incomplete last line is omitted.

    Args:
        path: The log.
        parse: Converts the JSON object of a line, None for a line to omit; raises `JSON_ERRORS` if it is invalid.
        motion: Kind of motion, for messages: `drive`.

    Raises:
        EvidenceError: The log is missing, empty, or has an invalid line.
    """
    lines = reading.json_lines(path, parse, f"is not a line of a {motion} log")
    moments = tuple(moment for moment in lines if moment is not None)
    if any(after.at_s < before.at_s for before, after in pairwise(moments)):
        raise EvidenceError("its lines are not in the order of time", where=str(path))
    if not moments:
        raise EvidenceError(f"contains no position of a {motion}", where=str(path))
    return moments


def time_contradictions(log: Sequence[MotionMoment], window: tuple[int, int] | None) -> Iterator[str]:
    """Yield the contradictions between the times of a log, one sentence each.

    Args:
        log: Its lines; lines without a time by the robot's clock are not checked.
        window: The robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if unknown.
    """
    timed = [moment for moment in log if moment.utc_ns]
    if not timed:
        return
    times_ns = [moment.utc_ns for moment in timed]
    if window is not None and (min(times_ns) < window[0] or max(times_ns) > window[1]):
        yield "has lines from before the attempt or after it, by the robot's clock"
    offsets_s = [moment.utc_ns / 1e9 - moment.at_s for moment in timed]
    if max(offsets_s) - min(offsets_s) > _STALL_S:
        yield "its two clocks do not advance at the same rate"
    if times_ns != sorted(times_ns):
        yield "its lines are not in the order of the robot's clock"
