"""Messages that were lost, by the gaps in numbers that come again after 256 of them, as MAVLink's do."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

NUMBERS: Final = 256
SILENCE_US: Final = 1_000_000
"""After so long a time without a message its number alone does not tell how many were lost."""


@dataclass(frozen=True)
class Counted:
    """What numbers tell.

    Attributes:
        messages: Messages that came, each once.
        lost: Those that did not.
        repeated: Those that came once more.
        silence_s: Longest time without one.
        rate_hz: Messages a second that were sent, while they came.
    """

    messages: int
    lost: int
    repeated: int
    silence_s: float
    rate_hz: float


def counted(came: Sequence[tuple[int, int]], ended_us: int) -> Counted:
    """Return how many messages came, and how many did not.

    Between two that come one after the other `(number - number before - 1) % 256` are missing. One that comes late
    is not. In a silence of more than 1 s whole rounds of 256 may have been lost, too: as many as bring the sum
    nearest to the rate at which they were sent otherwise; and after the last one, as many as that rate makes.

    Args:
        came: Of each message when it came, in us, and its number, in the order in which they came.
        ended_us: When nobody listened any more; 0 where nobody knows.
    """
    if not came:
        return Counted(0, 0, 0, 0.0, 0.0)
    rate_hz = _rate_hz(came)
    messages, lost, repeated, silence_us = 1, 0, 0, 0
    newest = came[0][1]
    for (before_us, _), (at_us, number) in pairwise(came):
        lasted_us, step = at_us - before_us, (number - newest) % NUMBERS
        silence_us = max(silence_us, lasted_us)
        silent = lasted_us > SILENCE_US
        if step == 0 and not silent:
            repeated += 1
        elif step > NUMBERS // 2 and not silent:
            messages, lost = messages + 1, max(lost - 1, 0)  # it was missed, and is late
        else:
            step = step or NUMBERS
            rounds = max(round((rate_hz * lasted_us / 1e6 - step) / NUMBERS), 0) if silent else 0
            messages, lost, newest = messages + 1, lost + step - 1 + NUMBERS * rounds, number
    tail_us = max(ended_us - came[-1][0], 0)
    if tail_us > SILENCE_US:
        lost += max(round(rate_hz * tail_us / 1e6) - 1, 0)
    return Counted(messages, lost, repeated, max(silence_us, tail_us) / 1e6, rate_hz)


def _rate_hz(came: Sequence[tuple[int, int]]) -> float:
    """Return how many messages were sent a second, by those that came without a silence between them."""
    steps = [
        (at_us - before_us, (number - before) % NUMBERS) for (before_us, before), (at_us, number) in pairwise(came)
    ]
    steady = [(us, step) for us, step in steps if 0 <= us <= SILENCE_US and step <= NUMBERS // 2]
    seconds = sum(us for us, _ in steady) / 1e6
    return sum(step for _, step in steady) / seconds if seconds > 0 else 0.0
