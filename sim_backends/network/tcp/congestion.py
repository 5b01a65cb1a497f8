"""The congestion window: slow start and congestion avoidance of RFC 5681. For CUBIC see `cubic`, `linux_cubic`."""

from typing import ClassVar

from sim_backends.network.tcp.options import TcpOptions


class NewReno:
    """Window and threshold of RFC 5681, with the recovery of RFC 6582 and 6675.

    Args:
        options: Segments, and how the window begins and opens.

    Attributes:
        window_bytes: The congestion window (cwnd).
        threshold_bytes: Where slow start ends (ssthresh); None while it is as high as can be.
        reduces_in_recovery: Whether a timeout within a recovery lowers the threshold again (RFC 5681, 3.1).
    """

    reduces_in_recovery: ClassVar[bool] = True

    def __init__(self, options: TcpOptions) -> None:
        self._options = options
        self._segment_bytes = options.segment_bytes
        self.window_bytes = options.initial_window_segments * options.segment_bytes
        self.threshold_bytes: int | None = None
        # What the window is to grow by, in fractions of a byte: numerator over the window.
        self._credit = 0

    @property
    def in_slow_start(self) -> bool:
        """Whether the window is below the threshold."""
        return self.threshold_bytes is None or self.window_bytes < self.threshold_bytes

    def acknowledged(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:
        """Open the window by an ACK of new data that was sent while the window was full.

        Args:
            now_ns: Now.
            acked_bytes: What it shows to have arrived that neither an ACK nor a SACK told of before.
            round_trip_ns: The smoothed round trip.
        """
        if self.in_slow_start:
            acked_bytes = self._slow_start(acked_bytes)
        if acked_bytes and not self.in_slow_start:
            self._avoid(now_ns, acked_bytes, round_trip_ns)

    def idled(self, idle_ns: int) -> None:
        """Learn that for so long the program, not the window, said how much was sent."""

    def lost(self, flight_bytes: int) -> None:
        """Close the window after a loss that was seen by SACK, with so much under way (RFC 6675, 5, step 4.2)."""
        self.threshold_bytes = self._reduced(flight_bytes)
        self.window_bytes = self.threshold_bytes
        self._credit = 0

    def timed_out(self, flight_bytes: int, *, again: bool) -> None:
        """Close the window after a timeout (RFC 5681, 3.1); `again` is one with no progress since the last one."""
        if not again:
            self.threshold_bytes = self._reduced(flight_bytes)
        self.window_bytes = self._segment_bytes
        self._credit = 0

    def restarted(self) -> None:
        """Fall back to the initial window after silence (RFC 5681, 4.1)."""
        initial_bytes = self._options.initial_window_segments * self._segment_bytes
        self.window_bytes = min(self.window_bytes, initial_bytes)

    def begun_late(self) -> None:
        """Begin with a window of one segment, as more than one SYN was lost (RFC 6928, 2)."""
        self.window_bytes = self._segment_bytes

    def _slow_start(self, acked_bytes: int) -> int:
        """Open the window up to the threshold; return what was acknowledged beyond that (RFC 5681, 3.1)."""
        limit = self._options.bytes_counted_segments
        counted_bytes = acked_bytes if limit is None else min(acked_bytes, limit * self._segment_bytes)
        if self.threshold_bytes is not None:
            counted_bytes = min(counted_bytes, self.threshold_bytes - self.window_bytes)
        self.window_bytes += counted_bytes
        return acked_bytes - counted_bytes if limit is None else 0

    def _avoid(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:  # noqa: ARG002 (see Cubic)
        """Open the window by a segment per window that was acknowledged (RFC 5681, 3.1)."""
        self._grow(self._segment_bytes * acked_bytes)

    def _grow(self, numerator: int) -> None:
        """Grow by `numerator` over the window, and keep what is less than a byte for later."""
        self._credit += numerator
        more_bytes, self._credit = divmod(self._credit, self.window_bytes)
        self.window_bytes += more_bytes

    def _reduced(self, flight_bytes: int) -> int:
        """Return the threshold after a loss (RFC 5681, equation 4)."""
        return max(flight_bytes // 2, 2 * self._segment_bytes)
