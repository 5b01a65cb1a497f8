"""Common reader and checks of the logs of drives and flights: order of lines, agreement of two clocks."""

import json
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import JSON_ERRORS
from fieldkit.measure.evidence import reading

LONGEST_M: Final = 1e6
LONGEST_S: Final = 1e6
LAST_NS: Final = 2**62
"""Limits of valid values."""
_STALL_S: Final = 2.0
"""Maximum time for which a busy robot may suspend the program between its readings of the two clocks."""


_END: Final = re.compile(r'(.*), "crc32": ([0-9]{1,10})\}', re.ASCII)
"""Last line of a log, which contains the CRC-32 of the log without the key `crc32`."""


class MotionMoment(Protocol):
    """A line of a log.

    Attributes:
        at_s: Time since the start of the log, by a clock that is never set.
        utc_ns: Time by the robot's clock, nanoseconds since 1970 UTC; 0 if the line does not have it.
    """

    @property
    def at_s(self) -> float:
        """Time since the start of the log, by a clock that is never set."""

    @property
    def utc_ns(self) -> int:
        """Time by the robot's clock, nanoseconds since 1970 UTC; 0 if the line does not have it."""


_Moment = TypeVar("_Moment", bound=MotionMoment)
_Value = TypeVar("_Value")


def read(path: Path, parse: Callable[[Mapping[str, Any]], _Moment | None], motion: str) -> tuple[_Moment, ...]:
    """Return the lines of a log in chronological order; an incomplete last line is omitted.

    Args:
        path: The log.
        parse: Converts the JSON object of a line, or returns None to omit it; raises `JSON_ERRORS` if it is invalid.
        motion: Kind of motion, for messages: `drive`.

    Raises:
        EvidenceError: The log is missing, empty, has an invalid line, or its lines are not in order.
    """
    lines = _json_lines(path, parse, f"is not a line of a {motion} log")
    moments = tuple(moment for moment in lines if moment is not None)
    if any(after.at_s < before.at_s for before, after in pairwise(moments)):
        raise EvidenceError("its lines are not in chronological order", where=str(path))
    if not moments:
        raise EvidenceError(f"contains no position of a {motion}", where=str(path))
    return moments


def _json_lines(path: Path, parse: Callable[[Any], _Value], error_text: str) -> list[_Value]:
    """Return the parsed JSON lines of a log; an incomplete last line is omitted.

    Args:
        path: The log.
        parse: Converts the value of a line; raises one of `JSON_ERRORS` if it is invalid.
        error_text: Predicate of the message about an invalid line: `is not a sample of a drive`.

    Raises:
        EvidenceError: The log cannot be read (see `reading.text`), or a line is invalid.
    """
    values = []
    for number, line in enumerate(reading.text(path).split("\n")[:-1], 1):
        try:
            values.append(parse(json.loads(line)))
        except JSON_ERRORS:
            raise EvidenceError(f"line {number} {error_text}", where=str(path)) from None
    return values


def numbered_lines_problem(path: Path) -> str | None:
    """Return the reason why a log is not complete; None if it is, or if its lines have no numbers.

    Raises:
        EvidenceError: For the same reasons as `reading.text`.
    """
    log_text = reading.text(path)
    lines = log_text.splitlines(keepends=True)
    numbers = [_number(line) for line in lines]
    if all(number is None for number in numbers):
        return None
    if numbers != list(range(len(lines))):
        return "its line numbers have a gap: lines are missing or were changed"
    end = _END.fullmatch(lines[-1].rstrip("\n"))
    if end is None or not lines[-1].endswith("\n"):
        return "its last line is missing: its writer was killed"
    head = "".join(lines[:-1]) + end[1] + "}"
    return (
        None if zlib.crc32(head.encode("utf-8", "replace")) == int(end[2]) else "was changed: its checksum is wrong"
    )


def _number(line: str) -> int | None:
    try:
        value: Any = json.loads(line)
    except JSON_ERRORS:
        return None
    number = value.get("n") if isinstance(value, dict) else None
    return number if type(number) is int else None


def time_contradictions(log: Sequence[MotionMoment], window: tuple[int, int] | None) -> Iterator[str]:
    """Yield the contradictions between the times of a log, one sentence each.

    Args:
        log: Lines of the log; lines without a time by the robot's clock are not checked.
        window: Readings of the robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if
            unknown.
    """
    timed_moments = [moment for moment in log if moment.utc_ns]
    if not timed_moments:
        return
    times_ns = [moment.utc_ns for moment in timed_moments]
    if window is not None and (min(times_ns) < window[0] or max(times_ns) > window[1]):
        yield "has lines from before the attempt or after it, by the robot's clock"
    offsets_s = [moment.utc_ns / 1e9 - moment.at_s for moment in timed_moments]
    if max(offsets_s) - min(offsets_s) > _STALL_S:
        yield "its two clocks do not advance at the same rate"
    if times_ns != sorted(times_ns):
        yield "its lines are not in chronological order by the robot's clock"
