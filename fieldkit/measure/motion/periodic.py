"""Loss of messages that an autopilot sends periodically to all stations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean
from typing import Final

from fieldkit.measure.evidence.sequence import NUMBERS, SILENCE_US

MIN_MESSAGES: Final = 10
"""Minimum number of messages of a stream from which its period can be estimated."""
_PHASE_GAIN: Final = 0.1
"""Share of a message's deviation from its expected time by which the next expected time is corrected, because the
period is only an estimate."""


@dataclass(frozen=True)
class StreamMessage:
    """A message that contains the autopilot's time.

    Attributes:
        at_us: Time of arrival, microseconds.
        boot_ms: The autopilot's time (`time_boot_ms`), milliseconds.
        position: Index among all received messages of the autopilot.
    """

    at_us: int
    boot_ms: int
    position: int


def lost(
    numbers: Sequence[tuple[int, int]], streams: Mapping[str, Sequence[StreamMessage]], ended_us: int
) -> tuple[int, int]:
    """Return the number of received messages of periodic streams, and the number of lost ones.

    A message of a stream is counted as lost if the autopilot's times have a gap of at least 1.5 periods, but at most
    as many as there are missing sequence numbers in the gap. Therefore neither a number that a router filtered (of an
    answer to another station) nor a period that the autopilot skipped counts as a loss. If the autopilot only sent a
    message late, at the time of such an answer, the next message is early and cancels the loss. In a silence of more
    than 1 s, and between the last message and the end, the numbers are ambiguous, so only the period is used.

    Args:
        numbers: Time of arrival in us and sequence number of each message of the autopilot, in order of arrival.
        streams: Messages that contain a time, by name, in order of arrival.
        ended_us: End of the recording; 0 if unknown.
    """
    indices = _unwrap([number for _, number in numbers])
    received = lost_messages = 0
    tail_ms = max(ended_us - numbers[-1][0], 0) / 1e3 if numbers else 0.0
    for messages in streams.values():
        if len(messages) < MIN_MESSAGES or (period_ms := _period_ms(messages, indices)) <= 0:
            continue
        received += len(messages)
        lost_messages += _count_missing(messages, indices, period_ms)
        if tail_ms * 1e3 > SILENCE_US:
            lost_messages += max(round(tail_ms / period_ms) - 1, 0)
    return received, lost_messages


def _count_missing(messages: Sequence[StreamMessage], indices: Sequence[int], period_ms: float) -> int:
    """Return the number of messages of a stream that were lost between its first and its last one."""
    lost_messages, expected_ms = 0, float(messages[0].boot_ms)
    for before, after in pairwise(messages):
        if after.at_us - before.at_us > SILENCE_US:
            lost_messages += max(round((after.boot_ms - before.boot_ms) / period_ms) - 1, 0)
            expected_ms = after.boot_ms
            continue
        periods = round((after.boot_ms - expected_ms) / period_ms) - 1
        missing_numbers = indices[after.position] - indices[before.position] - (after.position - before.position)
        if periods > missing_numbers:  # the autopilot has skipped a period, or its phase has shifted
            lost_messages += missing_numbers
            expected_ms = after.boot_ms
        else:
            lost_messages += periods
            expected_ms += (periods + 1) * period_ms
            expected_ms += _PHASE_GAIN * (after.boot_ms - expected_ms)
    return max(lost_messages, 0)


def _period_ms(messages: Sequence[StreamMessage], indices: Sequence[int]) -> float:
    """Return the period of a stream: the interquartile mean of its intervals in which no sequence number is missing.

    The median of all intervals would be too large if messages are lost and the autopilot sends at multiples of its
    loop period.
    """
    pairs = list(pairwise(messages))
    complete = [
        after.boot_ms - before.boot_ms
        for before, after in pairs
        if indices[after.position] - indices[before.position] == after.position - before.position
    ]
    steps_ms = sorted(
        complete if len(complete) >= MIN_MESSAGES else [after.boot_ms - before.boot_ms for before, after in pairs]
    )
    edge = len(steps_ms) // 4
    return mean(steps_ms[edge : len(steps_ms) - edge])


def _unwrap(numbers: Sequence[int]) -> list[int]:
    """Return sequence numbers unwrapped beyond 255; a late message keeps its number below the newest."""
    indices, newest = list[int](), 0
    for number in numbers:
        if not indices:
            newest = number
        step = (number - newest) % NUMBERS
        indices.append(newest + (step if step <= NUMBERS // 2 else step - NUMBERS))
        newest = max(newest, indices[-1])
    return indices
