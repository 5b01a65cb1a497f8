"""The congestion window: slow start and congestion avoidance of RFC 5681. For CUBIC see `cubic`, `linux_cubic`."""

from typing import ClassVar

from sim_backends.network.tcp.options import TcpOptions


class NewReno:
    """Window and threshold of RFC 5681, with the recovery of RFC 6582 and 6675.

    Args:
        options: Segment size, initial window and growth of the window.

    Attributes:
        window_bytes: The congestion window (cwnd).
        threshold_bytes: End of slow start (ssthresh); None if it is unlimited.
        reduces_in_recovery: True if a timeout within a recovery lowers the threshold again (RFC 5681, 3.1).
    """

    reduces_in_recovery: ClassVar[bool] = True

    def __init__(self, options: TcpOptions) -> None:
        self._options = options
        self._segment_bytes = options.segment_bytes
        self.window_bytes = options.initial_window_segments * options.segment_bytes
        self.threshold_bytes: int | None = None
        # Fraction of a byte by which the window will grow: a numerator; the denominator is the window.
        self._credit = 0

    @property
    def in_slow_start(self) -> bool:
        """True if the window is below the threshold."""
        return self.threshold_bytes is None or self.window_bytes < self.threshold_bytes

    def on_ack(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:
        """Increase the window for an ACK of new data that was sent while the window was full.

        Args:
            now_ns: Current time.
            acked_bytes: Bytes newly reported as received, by ACK or SACK.
            round_trip_ns: The smoothed round trip.
        """
        if self.in_slow_start:
            acked_bytes = self._slow_start(acked_bytes)
        if acked_bytes and not self.in_slow_start:
            self._avoid_congestion(now_ns, acked_bytes, round_trip_ns)

    def on_idle(self, idle_ns: int) -> None:
        """Record a period in which the program, not the window, limited the sending rate."""

    def on_loss(self, flight_bytes: int) -> None:
        """Reduce the window after a loss detected by SACK, with these bytes in flight (RFC 6675, 5, step 4.2)."""
        self.threshold_bytes = self._reduced_threshold(flight_bytes)
        self.window_bytes = self.threshold_bytes
        self._credit = 0

    def on_timeout(self, flight_bytes: int, *, again: bool) -> None:
        """Reduce the window after a timeout (RFC 5681, 3.1); `again` means without progress since the last one."""
        if not again:
            self.threshold_bytes = self._reduced_threshold(flight_bytes)
        self.window_bytes = self._segment_bytes
        self._credit = 0

    def on_restart(self) -> None:
        """Reset the window to the initial window after an idle period (RFC 5681, 4.1)."""
        initial_bytes = self._options.initial_window_segments * self._segment_bytes
        self.window_bytes = min(self.window_bytes, initial_bytes)

    def on_syn_losses(self) -> None:
        """Start with a window of one segment, because more than one SYN was lost (RFC 6928, 2)."""
        self.window_bytes = self._segment_bytes

    def _slow_start(self, acked_bytes: int) -> int:
        """Increase the window up to the threshold; return the bytes acknowledged beyond that (RFC 5681, 3.1)."""
        limit = self._options.bytes_counted_segments
        counted_bytes = acked_bytes if limit is None else min(acked_bytes, limit * self._segment_bytes)
        if self.threshold_bytes is not None:
            counted_bytes = min(counted_bytes, self.threshold_bytes - self.window_bytes)
        self.window_bytes += counted_bytes
        return acked_bytes - counted_bytes if limit is None else 0

    def _avoid_congestion(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:  # noqa: ARG002 (see Cubic)
        """Increase the window by one segment per acknowledged window (RFC 5681, 3.1)."""
        self._increase(self._segment_bytes * acked_bytes)

    def _increase(self, numerator: int) -> None:
        """Increase the window by `numerator` / window, and keep the fraction of a byte for later."""
        self._credit += numerator
        more_bytes, self._credit = divmod(self._credit, self.window_bytes)
        self.window_bytes += more_bytes

    def _reduced_threshold(self, flight_bytes: int) -> int:
        """Return the threshold after a loss (RFC 5681, equation 4)."""
        return max(flight_bytes // 2, 2 * self._segment_bytes)
