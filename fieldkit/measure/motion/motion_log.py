"""What the logs of drives and of flights share: lines in the order of time, and two clocks that agree."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import reading

LONGEST_M: Final = 1e6
LONGEST_S: Final = 1e6
LAST_NS: Final = 2**62
"""Larger values are errors of the log."""
_STALL_S: Final = 2.0
"""Between the two times of a line a busy robot may stop its program for this long."""


class MotionMoment(Protocol):
    """A line of a log.

    Attributes:
        at_s: Time since the start of the program.
        utc_ns: Time by the robot's clock, nanoseconds since 1970 UTC; 0 if the line does not have it.
    """

    @property
    def at_s(self) -> float:
        """See the class."""

    @property
    def utc_ns(self) -> int:
        """See the class."""


_Moment = TypeVar("_Moment", bound=MotionMoment)


def read(path: Path, parse: Callable[[Mapping[str, Any]], _Moment | None], motion: str) -> tuple[_Moment, ...]:
    """Return the lines of a log in the order of time; a last one that is not whole is left out.

    Args:
        path: The log.
        parse: Makes the moment of a line, None for a line without one; raises what `reading.json_lines` catches.
        motion: What the log is of, for messages: `a robot drove`.

    Raises:
        EvidenceError: It is missing, has no moment, or a line that is wrong.
    """
    lines = reading.json_lines(path, parse, f"does not say where {motion}")
    moments = tuple(moment for moment in lines if moment is not None)
    if any(after.at_s < before.at_s for before, after in pairwise(moments)):
        raise EvidenceError("its lines are not in the order of time", where=str(path))
    if not moments:
        raise EvidenceError(f"says nothing of where {motion}", where=str(path))
    return moments


def time_contradictions(log: Sequence[MotionMoment], window: tuple[int, int] | None) -> Iterator[str]:
    """Yield what cannot be true of the times of a log, a sentence each.

    Args:
        log: Its moments; those without a time by the robot's clock are not checked.
        window: The robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if it is not known.
    """
    known = [moment for moment in log if moment.utc_ns]
    if not known:
        return
    times_ns = [moment.utc_ns for moment in known]
    if window is not None and (min(times_ns) < window[0] or max(times_ns) > window[1]):
        yield "has lines from before the attempt or after it, by the robot's clock"
    late_s = [moment.utc_ns / 1e9 - moment.at_s for moment in known]
    if max(late_s) - min(late_s) > _STALL_S:
        yield "its two clocks do not advance alike"
    if times_ns != sorted(times_ns):
        yield "its lines are not in the order of the robot's clock"
