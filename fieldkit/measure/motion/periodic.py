"""Lost messages of streams that an autopilot sends at a fixed period, which are addressed to every station."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean
from typing import Final

from fieldkit.measure.evidence.sequence import NUMBERS, SILENCE_US

LEAST: Final = 10
"""With fewer messages of a stream its period is not known."""
_FOLLOWS: Final = 0.1
"""Share of a message's deviation from its expected time that the next one follows: the period is an estimate."""


@dataclass(frozen=True)
class StreamMessage:
    """A message with the time of the autopilot in it.

    Attributes:
        at_us: When it came, microseconds.
        boot_ms: The autopilot's own time (`time_boot_ms`), milliseconds.
        position: Index among all messages of the autopilot that came.
    """

    at_us: int
    boot_ms: int
    position: int


def lost(
    numbers: Sequence[tuple[int, int]], streams: Mapping[str, Sequence[StreamMessage]], ended_us: int
) -> tuple[int, int]:
    """Return how many messages of periodic streams came, and how many of them were lost.

    A message of a stream is counted as lost where the autopilot's own times have a gap of at least 1.5 periods, and
    only as many as numbers of messages are missing in that gap. So neither a number that a router withheld (of an
    answer to another station) nor a period that the autopilot skipped is a loss. A message that the autopilot only
    sent late, at the time of such an answer, is followed by one that comes early, which takes the loss back. In a
    silence of more than 1 s, and between the last message and the end, numbers are ambiguous, and the period counts
    alone.

    Args:
        numbers: Of each message of the autopilot when it came, in us, and its number, in order of arrival.
        streams: Messages with a time, by their names, in order of arrival.
        ended_us: End of the recording; 0 where it is not known.
    """
    indices = _unwrapped([number for _, number in numbers])
    came = lacking = 0
    tail_ms = max(ended_us - numbers[-1][0], 0) / 1e3 if numbers else 0.0
    for messages in streams.values():
        if len(messages) < LEAST or (period_ms := _period_ms(messages, indices)) <= 0:
            continue
        came += len(messages)
        lacking += _lacking(messages, indices, period_ms)
        if tail_ms * 1e3 > SILENCE_US:
            lacking += max(round(tail_ms / period_ms) - 1, 0)
    return came, lacking


def _lacking(messages: Sequence[StreamMessage], indices: Sequence[int], period_ms: float) -> int:
    """Return how many messages of a stream are missing between its first and its last one."""
    lacking, expected_ms = 0, float(messages[0].boot_ms)
    for before, after in pairwise(messages):
        if after.at_us - before.at_us > SILENCE_US:
            lacking += max(round((after.boot_ms - before.boot_ms) / period_ms) - 1, 0)
            expected_ms = after.boot_ms
            continue
        periods = round((after.boot_ms - expected_ms) / period_ms) - 1
        missing = indices[after.position] - indices[before.position] - (after.position - before.position)
        if periods > missing:  # the autopilot has skipped a period, or sends late from now on
            lacking += missing
            expected_ms = after.boot_ms
        else:
            lacking += periods
            expected_ms += (periods + 1) * period_ms
            expected_ms += _FOLLOWS * (after.boot_ms - expected_ms)
    return max(lacking, 0)


def _period_ms(messages: Sequence[StreamMessage], indices: Sequence[int]) -> float:
    """Return the period of a stream: the mean of the middle half of its steps in which no number is missing.

    A median of all steps is too large where messages are lost and the autopilot sends at multiples of its own period.
    """
    pairs = list(pairwise(messages))
    whole = [
        after.boot_ms - before.boot_ms
        for before, after in pairs
        if indices[after.position] - indices[before.position] == after.position - before.position
    ]
    steps_ms = sorted(whole if len(whole) >= LEAST else [after.boot_ms - before.boot_ms for before, after in pairs])
    edge = len(steps_ms) // 4
    return mean(steps_ms[edge : len(steps_ms) - edge])


def _unwrapped(numbers: Sequence[int]) -> list[int]:
    """Return numbers that do not begin again after 255; one that is late stays before the newest."""
    indices, newest = list[int](), 0
    for number in numbers:
        if not indices:
            newest = number
        step = (number - newest) % NUMBERS
        indices.append(newest + (step if step <= NUMBERS // 2 else step - NUMBERS))
        newest = max(newest, indices[-1])
    return indices
