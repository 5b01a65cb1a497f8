"""When programs wake that do something at a fixed rate."""

from typing import Final

from fieldkit.core.errors import ConfigurationError

PERIOD_NS: Final = 50_000_000
"""A controller's usual 20 Hz (ROS 2 Navigation, `controller_frequency`)."""


class NeverSends:
    """A program that steers its body, and sends nothing."""

    def next_send_ns(self) -> None:
        """See `federates.next_send_ns`."""


class Beat:
    """Times at a fixed distance.

    Args:
        period_ns: From one to the next.
        begin_ns: The first.

    Attributes:
        next_ns: The next.

    Raises:
        ConfigurationError: The distance is not above 0.
    """

    def __init__(self, period_ns: int, begin_ns: int = 0) -> None:
        if period_ns <= 0:
            raise ConfigurationError(f"nothing is done every {period_ns} ns", remedy="give it a period above 0")
        self.next_ns = begin_ns
        self._period_ns = period_ns

    def is_due(self, now_ns: int) -> bool:
        """Return whether it is time, and go to the next; what was missed, as by a clock set ahead, stays so."""
        late_ns = now_ns - self.next_ns
        if late_ns < 0:
            return False
        self.next_ns += self._period_ns * (late_ns // self._period_ns + 1)
        return True
