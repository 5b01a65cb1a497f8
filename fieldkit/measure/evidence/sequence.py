"""Loss of messages, computed from gaps in sequence numbers that wrap after 256 messages, as in MAVLink."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

NUMBERS: Final = 256
"""Number of different sequence numbers."""
SILENCE_US: Final = 1_000_000
"""After this time without a message, sequence numbers may have wrapped. They are then not sufficient to compute the
number of lost messages."""


@dataclass(frozen=True)
class MessageCounts:
    """Message counts derived from sequence numbers.

    Attributes:
        messages: Received messages without duplicates.
        lost: Lost messages.
        repeated: Duplicates.
        silence_s: Longest time without a message, after the first message.
        rate_hz: Rate at which messages were sent in the time without silences; 0 if it cannot be computed.
    """

    messages: int
    lost: int
    repeated: int
    silence_s: float
    rate_hz: float


def count_messages(arrivals: Sequence[tuple[int, int]], end_us: int) -> MessageCounts:
    """Count received and lost messages.

    Between two consecutive messages, `(number - previous number - 1) % 256` messages are missing; a message that
    arrives late is not lost. In a silence of more than 1 s, a multiple of 256 further messages may be lost. The
    multiple that agrees best with the message rate outside of silences is used. After the last message, the loss is
    computed from this rate. Without arrivals, all values are 0.

    Args:
        arrivals: Time of arrival in us and sequence number of each message, in the order of arrival.
        end_us: End of the reception in us; 0 if unknown.
    """
    if not arrivals:
        return MessageCounts(0, 0, 0, 0.0, 0.0)
    rate_hz = _rate_hz(arrivals)
    messages, lost, repeated, silence_us = 1, 0, 0, 0
    last_number = arrivals[0][1]
    for (before_us, _), (at_us, number) in pairwise(arrivals):
        interval_us, step = at_us - before_us, (number - last_number) % NUMBERS
        silence_us = max(silence_us, interval_us)
        is_silence = interval_us > SILENCE_US
        if step == 0 and not is_silence:
            repeated += 1
        elif step > NUMBERS // 2 and not is_silence:
            messages, lost = messages + 1, max(lost - 1, 0)  # the message is late, and was counted as lost
        else:
            step = step or NUMBERS  # after a silence, an equal number shows that the numbers wrapped
            wraps = max(round((rate_hz * interval_us / 1e6 - step) / NUMBERS), 0) if is_silence else 0
            messages, lost, last_number = messages + 1, lost + step - 1 + NUMBERS * wraps, number
    tail_us = max(end_us - arrivals[-1][0], 0)
    if tail_us > SILENCE_US:
        lost += max(round(rate_hz * tail_us / 1e6) - 1, 0)
    return MessageCounts(messages, lost, repeated, max(silence_us, tail_us) / 1e6, rate_hz)


def _rate_hz(arrivals: Sequence[tuple[int, int]]) -> float:
    """Return the rate of sent messages in Hz, computed from arrivals without a silence between them."""
    steps = [
        (at_us - previous_us, (number - previous) % NUMBERS)
        for (previous_us, previous), (at_us, number) in pairwise(arrivals)
    ]
    regular_steps = [
        (interval_us, step) for interval_us, step in steps if 0 <= interval_us <= SILENCE_US and step <= NUMBERS // 2
    ]
    duration_s = sum(interval_us for interval_us, _ in regular_steps) / 1e6
    return sum(step for _, step in regular_steps) / duration_s if duration_s > 0 else 0.0
