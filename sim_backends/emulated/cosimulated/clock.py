"""Converts between the simulated time of a session and the monotonic clock."""

import time


class RealTime:
    """Maps simulated time to the monotonic clock.

    Attributes:
        epoch_ns: Time of the monotonic clock at simulated time 0.
    """

    def __init__(self) -> None:
        self.epoch_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the current simulated time."""
        return time.monotonic_ns() - self.epoch_ns

    def monotonic_ns(self, simulated_ns: int) -> int:
        """Return the time of the monotonic clock at a simulated time."""
        return self.epoch_ns + simulated_ns

    def simulated_ns(self, monotonic_ns: int) -> int:
        """Return the simulated time at a time of the monotonic clock."""
        return monotonic_ns - self.epoch_ns

    def skip_lag(self, lag_ns: int) -> None:
        """Delay simulated time by a lag, so that a late simulation does not have to catch up."""
        self.epoch_ns += lag_ns
