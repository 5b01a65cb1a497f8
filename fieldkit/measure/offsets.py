"""The offset of a robot's clock against the laptop's, with the most that it can be wrong."""

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Exchange:
    """One question for the time, as in RFC 5905, section 8, with a robot that takes no time to answer.

    Attributes:
        asked_ns: The laptop's clock before it asked, nanoseconds since 1970 UTC.
        robot_ns: The robot's clock at some moment in between.
        answered_ns: The laptop's clock when it had the answer.
        resolution_ns: The robot's clock was between `robot_ns` and so much later; 0 for a clock that tells all.
    """

    asked_ns: int
    robot_ns: int
    answered_ns: int
    resolution_ns: int = 0

    @property
    def width_ns(self) -> int:
        """Width of the interval that the offset is in."""
        return self.answered_ns - self.asked_ns + self.resolution_ns


@dataclass(frozen=True)
class Offset:
    """Offset of a robot's clock, ahead of the laptop's.

    Attributes:
        offset_s: The best estimate, in seconds; negative when the robot's clock is behind.
        error_s: The most that the estimate can be wrong, however the round trip was divided.
    """

    offset_s: float
    error_s: float


def offset(exchanges: Sequence[Exchange]) -> Offset:
    """Return the offset by the exchange that took the least time: its midpoint, and half its width as the error.

    The robot read its clock somewhere between question and answer, so its offset lies between `robot - answered` and
    `robot + resolution - asked`.

    Raises:
        ValueError: There is no exchange.
    """
    best = min(exchanges, key=lambda one: one.width_ns)
    middle_ns = best.robot_ns + best.resolution_ns / 2 - best.asked_ns - (best.answered_ns - best.asked_ns) / 2
    return Offset(offset_s=middle_ns / 1e9, error_s=best.width_ns / 2e9)


def parse_date(text: str) -> tuple[int, int] | None:
    """Return what `date -u +%s.%N` said as nanoseconds since 1970 and their resolution; None when it said no time.

    busybox knows no `%N` and prints it, or nothing, so that its seconds stand for the whole second after them.
    """
    seconds, _, fraction = text.strip().partition(".")
    if not (seconds.isascii() and seconds.isdigit() and len(seconds) <= 11):
        return None
    if len(fraction) == 9 and fraction.isascii() and fraction.isdigit():
        return int(seconds) * 10**9 + int(fraction), 0
    return int(seconds) * 10**9, 10**9
