"""Loss of messages that an autopilot sends to every station at a fixed period.

Stations are the programs that receive its messages, such as a ground station and fieldkit's recorder.

Sequence numbers alone overestimate this loss: a router withholds messages that are addressed to other stations, and
their numbers are missing too. Therefore, a message counts as lost only if the autopilot's time (`time_boot_ms`) shows
that a message was due, and a sequence number is missing at that time.

An autopilot sends late when it is busy, and catches up. The received messages of a stream are therefore assigned to
its periods together, not one gap at a time. The assignment with the least sum of squared deviations from the schedule
is used (a beam search over the number of lost messages).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean
from typing import Final, NamedTuple

from fieldkit.measure.evidence.sequence import NUMBERS, SILENCE_US

_MIN_MESSAGES: Final = 10
"""A stream with fewer messages is not counted."""
_MIN_INTERVALS: Final = 3
"""Minimum number of intervals without a missing sequence number that are needed to estimate a period."""
_REQUEST_TOLERANCE: Final = 0.25
"""Maximum relative difference between the observed and the requested period. A larger difference shows that another
station changed the rate. Without such a change, the observed mean is still too short, because long intervals, which
contain a missing sequence number more often, are omitted."""
_RATE_TOLERANCE: Final = 0.08
"""Maximum relative difference between the observed rate and an integer rate, for a stream without a request."""
_MAX_RATE_HZ: Final = 10
"""Higher integer rates are too similar to be distinguished."""
_PHASE_GAIN: Final = 0.03
"""Share of a deviation by which the schedule is corrected. With a larger gain, late messages shift the schedule; with
a smaller one, it does not follow the drift of a period that is known to 0.1 %."""
_SKIP_COST: Final = 1.0
"""Cost of a period that the autopilot skipped, in squared periods: more than the squared deviation of one late
message, less than the sum for two."""
_HYPOTHESES: Final = 4
"""Maximum number of hypotheses that are kept. After late messages, two or three hypotheses are still possible."""


@dataclass(frozen=True)
class StreamMessage:
    """A received message with the time of the autopilot in it.

    Attributes:
        at_us: Time of arrival, microseconds.
        boot_ms: The autopilot's time (`time_boot_ms`), milliseconds.
        position: Index among all received messages of the autopilot.
    """

    at_us: int
    boot_ms: int
    position: int


class _Hypothesis(NamedTuple):
    """An assignment of the messages read so far to periods; hypotheses are ordered by cost.

    Attributes:
        cost: Sum of squared deviations and of costs of skipped periods, in squared periods.
        phase_ms: Scheduled time of the last of these messages, milliseconds.
        lost_count: Number of lost messages.
    """

    cost: float
    phase_ms: float
    lost_count: int


def count_messages(
    numbers: Sequence[tuple[int, int]],
    streams: Mapping[str, Sequence[StreamMessage]],
    ended_us: int,
    intervals_us: Mapping[str, int] | None = None,
) -> tuple[int, int]:
    """Return the number of received and the number of lost messages of all periodic streams.

    In a silence of more than 1 s, and between the last message and the end, sequence numbers are ambiguous (they
    repeat after 256 messages), so only the period is used. A period that an overloaded autopilot skips counts as a
    loss if a number is missing at that time.

    Args:
        numbers: Time of arrival (microseconds) and sequence number of each message of the autopilot, in order of
            arrival.
        streams: Messages that contain `time_boot_ms`, in order of arrival, by message name.
        ended_us: End of the recording; 0 if unknown.
        intervals_us: Requested intervals in microseconds, by message name; None if there are no requests. A stream
            without a request, or with a different period, is counted if its rate is an integer number of hertz up
            to 10.
    """
    indices = _unwrap([number for _, number in numbers])
    received_count = lost_count = 0
    tail_us = max(ended_us - numbers[-1][0], 0) if numbers else 0
    for name, messages in streams.items():
        if len(messages) < _MIN_MESSAGES:
            continue
        if (period_ms := _period_ms(messages, indices, (intervals_us or {}).get(name))) is None:
            continue
        received_count += len(messages)
        lost_count += _best_assignment(messages, indices, period_ms).lost_count
        if tail_us > SILENCE_US:
            lost_count += max(round(tail_us / 1e3 / period_ms) - 1, 0)
    return received_count, lost_count


def _best_assignment(messages: Sequence[StreamMessage], indices: Sequence[int], period_ms: float) -> _Hypothesis:
    """Return the best hypothesis about the messages of a stream that were lost between its first and its last one."""
    hypotheses = [_Hypothesis(0.0, float(messages[0].boot_ms), 0)]
    for before, after in pairwise(messages):
        if after.at_us - before.at_us > SILENCE_US:
            lost_in_silence = max(round((after.boot_ms - before.boot_ms) / period_ms) - 1, 0)
            best = hypotheses[0]
            hypotheses = [_Hypothesis(best.cost, float(after.boot_ms), best.lost_count + lost_in_silence)]
            continue
        missing_count = max(
            indices[after.position] - indices[before.position] - (after.position - before.position), 0
        )
        cheapest = dict[int, _Hypothesis]()
        for hypothesis in hypotheses:
            for candidate in _next_hypotheses(hypothesis, after.boot_ms, missing_count, period_ms):
                cheapest[candidate.lost_count] = min(cheapest.get(candidate.lost_count, candidate), candidate)
        hypotheses = sorted(cheapest.values())[:_HYPOTHESES]
    return hypotheses[0]


def _next_hypotheses(before: _Hypothesis, boot_ms: int, missing_count: int, period_ms: float) -> list[_Hypothesis]:
    """Return the hypotheses after the next message; at most `missing_count` messages before it were lost."""
    elapsed_periods = (boot_ms - before.phase_ms) / period_ms
    nearest = max(round(elapsed_periods), 1)
    hypotheses = list[_Hypothesis]()
    for periods in range(max(nearest - 1, 1), nearest + 2):
        lost_before = min(periods - 1, missing_count)
        if skipped_periods := periods - 1 - lost_before:  # the schedule starts again at this message
            cost, phase_ms = before.cost + _SKIP_COST * skipped_periods, float(boot_ms)
        else:
            deviation = elapsed_periods - periods
            cost = before.cost + deviation**2
            phase_ms = before.phase_ms + (periods + _PHASE_GAIN * deviation) * period_ms
        hypotheses.append(_Hypothesis(cost, phase_ms, before.lost_count + lost_before))
    return hypotheses


def _period_ms(messages: Sequence[StreamMessage], indices: Sequence[int], interval_us: int | None) -> float | None:
    """Return the period of a stream in milliseconds, or None if it is unknown.

    The period is the requested interval if the stream has about this period, or if it has too few intervals to
    estimate the period. Otherwise it is the period of the nearest integer rate up to 10 Hz, because autopilots are
    configured in hertz.
    """
    intervals_ms = sorted(
        after.boot_ms - before.boot_ms
        for before, after in pairwise(messages)
        if indices[after.position] - indices[before.position] == after.position - before.position
    )
    if len(intervals_ms) < _MIN_INTERVALS:
        if interval_us:
            return interval_us / 1e3
        intervals_ms = sorted(after.boot_ms - before.boot_ms for before, after in pairwise(messages))
    edge = len(intervals_ms) // 4  # the mean of the middle half is not affected by late messages
    observed_ms = mean(intervals_ms[edge : len(intervals_ms) - edge])
    if observed_ms <= 0:
        return None
    if interval_us and abs(observed_ms * 1e3 / interval_us - 1) <= _REQUEST_TOLERANCE:
        return interval_us / 1e3
    rate_hz = max(round(1e3 / observed_ms), 1)
    is_near = rate_hz <= _MAX_RATE_HZ and abs(rate_hz * observed_ms / 1e3 - 1) <= _RATE_TOLERANCE
    return 1e3 / rate_hz if is_near else None


def _unwrap(numbers: Sequence[int]) -> list[int]:
    """Return the sequence numbers without the wrap-around after 255.

    The number of a message that arrives late is smaller than the newest number.
    """
    indices, newest = list[int](), 0
    for number in numbers:
        if not indices:
            newest = number
        step = (number - newest) % NUMBERS
        indices.append(newest + (step if step <= NUMBERS // 2 else step - NUMBERS))
        newest = max(newest, indices[-1])
    return indices
