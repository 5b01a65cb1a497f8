"""The congestion window: slow start and congestion avoidance of RFC 5681, and CUBIC (RFC 9438).

CUBIC uses integer bytes and nanoseconds, so that results are equal on every machine. The CUBIC of Linux is in
`linux_cubic`.
"""

from typing import ClassVar, Final

from typing_extensions import override

from sim_backends.network.tcp.tcp_options import TcpOptions


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
        # Numerator of the fraction of a byte by which the window will grow; the denominator is the window.
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

    def on_timeout(self, flight_bytes: int, *, is_repeated: bool) -> None:
        """Reduce the window after a timeout (RFC 5681, 3.1).

        Args:
            flight_bytes: Bytes in flight.
            is_repeated: True if the threshold must stay, because there was no progress since the last timeout, or
                because a recovery is in progress (see `reduces_in_recovery`).
        """
        if not is_repeated:
            self.threshold_bytes = self._reduced_threshold(flight_bytes)
        self.window_bytes = self._segment_bytes
        self._credit = 0

    def on_restart(self) -> None:
        """Reduce the window to the initial window after an idle period, unless it is smaller (RFC 5681, 4.1)."""
        initial_bytes = self._options.initial_window_segments * self._segment_bytes
        self.window_bytes = min(self.window_bytes, initial_bytes)

    def on_syn_losses(self) -> None:
        """Start with a window of one segment, because more than one SYN was lost (RFC 6928, 2)."""
        self.window_bytes = self._segment_bytes

    def _slow_start(self, acked_bytes: int) -> int:
        """Increase the window up to the threshold (RFC 5681, 3.1).

        Returns:
            The acknowledged bytes that remain for congestion avoidance; 0 with a limit of the increase per ACK.
        """
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
        growth_bytes, self._credit = divmod(self._credit, self.window_bytes)
        self.window_bytes += growth_bytes

    def _reduced_threshold(self, flight_bytes: int) -> int:
        """Return the threshold after a loss (RFC 5681, equation 4)."""
        return max(flight_bytes // 2, 2 * self._segment_bytes)


_NS_PER_S_CUBED: Final = 10**27
# RFC 9438, 5.1 and 4.6: C is 0.4 segments per s^3, beta is 0.7.
_C: Final = 4, 10
_BETA: Final = 7, 10
# 4.3: alpha is 3 (1 - beta) / (1 + beta) = 9 / 17.
_ALPHA: Final = 9, 17
# 4.2: the window grows by at most half in a round trip.
_MAX_GROWTH: Final = 3, 2


def cube_root(number: int) -> int:
    """Return the largest integer whose cube is at most `number`, which must not be negative."""
    if not number:
        return 0
    root = 1 << -(-number.bit_length() // 3)
    # Newton's method, started above the root, decreases until it reaches the root.
    while (lower := (2 * root + number // (root * root)) // 3) < root:
        root = lower
    return root


class Cubic(NewReno):
    """The window of RFC 9438; slow start as in RFC 5681, without HyStart++ (RFC 9406).

    An epoch is a period of congestion avoidance: it begins with the first growth of the window after a reduction.

    Args:
        options: Segment size, initial window and growth of the window.
    """

    def __init__(self, options: TcpOptions) -> None:
        super().__init__(options)
        # The plateau (W_max); None before the first loss and after a timeout (4.8, 4.10).
        self._w_max_bytes: int | None = None
        # The window before the last reduction for any reason (cwnd_prior); before the first reduction, the window at
        # the start of congestion avoidance, or None.
        self._cwnd_prior_bytes: int | None = None
        self._reset_epoch()

    @override
    def on_idle(self, idle_ns: int) -> None:
        """Exclude the idle time from the epoch (RFC 9438, 5.8)."""
        if self._epoch_ns is not None:
            self._epoch_ns += idle_ns

    @override
    def on_loss(self, flight_bytes: int) -> None:
        window_bytes = self.window_bytes
        self._cwnd_prior_bytes = window_bytes
        if self._w_max_bytes is not None and window_bytes < self._w_max_bytes:
            # Fast convergence (4.7): new flows have started, so leave capacity for them.
            self._w_max_bytes = window_bytes * (_BETA[0] + _BETA[1]) // (2 * _BETA[1])
        else:
            self._w_max_bytes = window_bytes
        super().on_loss(flight_bytes)
        self._reset_epoch()

    @override
    def on_timeout(self, flight_bytes: int, *, is_repeated: bool) -> None:
        if not is_repeated:
            self._cwnd_prior_bytes = self.window_bytes
        super().on_timeout(flight_bytes, is_repeated=is_repeated)
        self._w_max_bytes = None
        self._reset_epoch()

    @override
    def on_restart(self) -> None:
        super().on_restart()
        self._reset_epoch()

    def cubic_bytes(self, since_ns: int) -> int:
        """Return W_cubic at `since_ns` after congestion avoidance started (equation 1)."""
        offset_ns = since_ns - self._plateau_ns
        return self._origin_bytes + self._segment_bytes * _C[0] * offset_ns**3 // (_C[1] * _NS_PER_S_CUBED)

    def _reset_epoch(self) -> None:
        self._epoch_ns: int | None = None
        # Time from the start of the epoch to the plateau of the cubic function (K), and the window there.
        self._plateau_ns = 0
        self._origin_bytes = 0
        # The window that Reno would have (W_est).
        self._reno_bytes = 0
        self._reno_credit = 0

    def _start_epoch(self, now_ns: int) -> None:
        """Start congestion avoidance: compute W_max, K (equation 2) and W_est."""
        window_bytes = self.window_bytes
        self._epoch_ns = now_ns
        self._origin_bytes = max(self._w_max_bytes or 0, window_bytes)
        deficit_bytes = self._origin_bytes - window_bytes
        self._plateau_ns = cube_root(deficit_bytes * _C[1] * _NS_PER_S_CUBED // (_C[0] * self._segment_bytes))
        self._reno_bytes = window_bytes
        if self._cwnd_prior_bytes is None:
            self._cwnd_prior_bytes = window_bytes

    def _avoid_congestion(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:
        """Increase the window by the cubic function, or like Reno if this is larger (RFC 9438, 4.2 to 4.5)."""
        if self._epoch_ns is None:
            self._start_epoch(now_ns)
            assert self._epoch_ns is not None
        window_bytes = self.window_bytes
        since_ns = now_ns - self._epoch_ns
        self._update_reno_window(acked_bytes)
        if self.cubic_bytes(since_ns) < self._reno_bytes:
            self.window_bytes = max(window_bytes, self._reno_bytes)
            return
        max_bytes = window_bytes * _MAX_GROWTH[0] // _MAX_GROWTH[1]
        target_bytes = min(max(self.cubic_bytes(since_ns + round_trip_ns), window_bytes), max_bytes)
        self._increase((target_bytes - window_bytes) * acked_bytes)

    def _update_reno_window(self, acked_bytes: int) -> None:
        """Increase W_est, the window of a Reno with CUBIC's reduction factor (equation 4)."""
        assert self._cwnd_prior_bytes is not None
        # Above the window before the reduction, W_est grows as fast as Reno's window.
        alpha = (1, 1) if self._reno_bytes >= self._cwnd_prior_bytes else _ALPHA
        self._reno_credit += alpha[0] * self._segment_bytes * acked_bytes
        growth_bytes, self._reno_credit = divmod(self._reno_credit, alpha[1] * self.window_bytes)
        self._reno_bytes += growth_bytes

    def _reduced_threshold(self, flight_bytes: int) -> int:
        """Return the bytes in flight multiplied by beta, at least two segments (4.6)."""
        return max(flight_bytes * _BETA[0] // _BETA[1], 2 * self._segment_bytes)
