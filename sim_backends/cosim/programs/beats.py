"""Timers of programs that act at a fixed rate."""

from typing import Final

from fieldkit.core.errors import ConfigurationError

PERIOD_NS: Final = 50_000_000
"""Usual control rate, 20 Hz (ROS 2 Navigation, `controller_frequency`)."""


class NeverSends:
    """A program that steers its body, and sends nothing."""

    def next_send_ns(self) -> None:
        """Return None: it never sends."""


class PeriodicTimer:
    """A timer with a fixed period.

    Args:
        period_ns: Its period.
        begin_ns: Time at which it fires first.

    Attributes:
        next_ns: Time at which it fires next.

    Raises:
        ConfigurationError: The period is not above 0.
    """

    def __init__(self, period_ns: int, begin_ns: int = 0) -> None:
        if period_ns <= 0:
            raise ConfigurationError(f"a period of {period_ns} ns is not above 0", remedy="set a period above 0")
        self.next_ns = begin_ns
        self._period_ns = period_ns

    def fire_if_due(self, now_ns: int) -> bool:
        """Return True if the timer fires; missed periods, for example after a clock was set ahead, are skipped."""
        late_ns = now_ns - self.next_ns
        if late_ns < 0:
            return False
        self.next_ns += self._period_ns * (late_ns // self._period_ns + 1)
        return True
