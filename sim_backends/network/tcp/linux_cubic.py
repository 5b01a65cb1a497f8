"""The CUBIC of Linux (`net/ipv4/tcp_cubic.c`, Linux 4.x to 6.x), which robots use.

It differs from RFC 9438 (`congestion.Cubic`) in three ways that matter on lossy links. Its estimate of Reno's window
grows by at most 8/15 of a segment per round trip. Windows are whole segments. The growth rate is updated only when
the window has changed or 1/32 s has passed.
"""

from typing import ClassVar, Final

from sim_backends.network.tcp.congestion import NewReno, cube_root
from sim_backends.network.tcp.tcp_options import TcpOptions

_NS_PER_S_CUBED: Final = 10**27
# bic_scale 41: C is 410 / 1024 segments per s^3.
_C: Final = 410, 1024
# beta is 717 / 1024.
_BETA: Final = 717, 1024
# beta_scale: Reno's window grows by one segment per 15/8 acknowledged windows.
_RENO: Final = 15, 8
# Time after which the growth rate is updated even if the window has not changed: HZ / 32.
_UPDATE_NS: Final = 1_000_000_000 // 32
# Minimum number of acknowledged segments per segment of growth, and maximum before the first loss.
_MIN_ACKED_PER_SEGMENT: Final = 2
_MAX_ACKED_PER_SEGMENT_BEFORE_LOSS: Final = 20
# At and above the target, the number of acknowledged windows per segment of growth.
_WINDOWS_PER_SEGMENT_AT_TARGET: Final = 100


class LinuxCubic(NewReno):
    """The window of Linux's CUBIC; slow start as in RFC 5681, without HyStart.

    An epoch is a period of congestion avoidance: it begins with the first growth of the window after a reduction.

    Args:
        options: Segment size, initial window and growth of the window.

    Attributes:
        reduces_in_recovery: False: as in Linux (`tcp_enter_loss`), a timeout within a recovery does not lower the
            threshold again.
    """

    reduces_in_recovery: ClassVar[bool] = False

    def __init__(self, options: TcpOptions) -> None:
        super().__init__(options)
        # The window at the last loss, or less by fast convergence (W_max), in segments; 0 before the first loss and
        # after a timeout.
        self._w_max = 0
        self._min_round_trip_ns: int | None = None
        self._restart_epoch()

    def on_ack(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:
        """Increase the window, see `NewReno.on_ack`; also update the minimum round trip (delay_min)."""
        min_ns = self._min_round_trip_ns
        self._min_round_trip_ns = round_trip_ns if min_ns is None else min(min_ns, round_trip_ns)
        super().on_ack(now_ns, acked_bytes, round_trip_ns)

    def on_idle(self, idle_ns: int) -> None:
        """Exclude time without a full window from the epoch."""
        if self._epoch_ns is not None:
            self._epoch_ns += idle_ns

    def on_loss(self, flight_bytes: int) -> None:
        """Reduce the window after a loss, and start a new epoch (bictcp_recalc_ssthresh)."""
        window = self._window
        # Fast convergence: leave capacity for new flows.
        is_below_max = window < self._w_max
        self._w_max = window * (_BETA[0] + _BETA[1]) // (2 * _BETA[1]) if is_below_max else window
        super().on_loss(flight_bytes)
        self._restart_epoch()

    def on_timeout(self, flight_bytes: int, *, is_repeated: bool) -> None:
        """Reduce the window after a timeout, and reset the measurements of the path (bictcp_reset)."""
        super().on_timeout(flight_bytes, is_repeated=is_repeated)
        self._w_max = 0
        self._min_round_trip_ns = None
        self._restart_epoch()

    @property
    def _window(self) -> int:
        """The window in whole segments."""
        return self.window_bytes // self._segment_bytes

    def _restart_epoch(self) -> None:
        self._epoch_ns: int | None = None
        # Time from the start of the epoch to the plateau of the cubic function (K), and the window there in segments.
        self._plateau_ns = 0
        self._origin = 0
        # The window that Reno would have, in segments.
        self._reno = 0
        self._reno_acked_bytes = 0
        self._acked_per_segment = 0
        self._last_update_ns = 0
        self._window_at_last_update = 0

    def _avoid_congestion(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:  # noqa: ARG002 (the minimum is used)
        self._reno_acked_bytes += acked_bytes
        if self._window != self._window_at_last_update or now_ns - self._last_update_ns > _UPDATE_NS:
            self._update(now_ns, acked_bytes)
        needed_bytes = self._acked_per_segment * self._segment_bytes
        if self._credit >= needed_bytes:
            # Bytes acknowledged while the window grew more slowly count as one segment (tcp_cong_avoid_ai).
            self._credit = 0
            self.window_bytes += self._segment_bytes
        self._credit += acked_bytes
        growth, self._credit = divmod(self._credit, needed_bytes)
        self.window_bytes += growth * self._segment_bytes

    def _update(self, now_ns: int, acked_bytes: int) -> None:
        """Compute the number of acknowledged segments per segment of growth (bictcp_update)."""
        window = self._window
        self._window_at_last_update, self._last_update_ns = window, now_ns
        if self._epoch_ns is None:
            self._start_epoch(now_ns, acked_bytes)
        target = self._target(now_ns)
        acked_per_segment = (
            window // (target - window) if target > window else _WINDOWS_PER_SEGMENT_AT_TARGET * window
        )
        if not self._w_max:
            acked_per_segment = min(acked_per_segment, _MAX_ACKED_PER_SEGMENT_BEFORE_LOSS)
        reno_step_bytes = window * self._segment_bytes * _RENO[0] // _RENO[1]
        growth = max(self._reno_acked_bytes - 1, 0) // reno_step_bytes
        self._reno += growth
        self._reno_acked_bytes -= growth * reno_step_bytes
        if self._reno > window:
            acked_per_segment = min(acked_per_segment, window // (self._reno - window))
        self._acked_per_segment = max(acked_per_segment, _MIN_ACKED_PER_SEGMENT)

    def _start_epoch(self, now_ns: int, acked_bytes: int) -> None:
        """Start an epoch: compute the window at the plateau of the cubic function, and the time until then (K)."""
        window = self._window
        self._epoch_ns = now_ns
        self._reno, self._reno_acked_bytes = window, acked_bytes
        self._origin = max(self._w_max, window)
        self._plateau_ns = cube_root((self._origin - window) * _C[1] * _NS_PER_S_CUBED // _C[0])

    def _target(self, now_ns: int) -> int:
        """Return the value of the cubic function one round trip from now, in segments."""
        assert self._epoch_ns is not None
        since_ns = now_ns - self._epoch_ns + (self._min_round_trip_ns or 0)
        offset_ns = since_ns - self._plateau_ns
        change = _C[0] * abs(offset_ns) ** 3 // (_C[1] * _NS_PER_S_CUBED)
        return self._origin - change if offset_ns < 0 else self._origin + change

    def _reduced_threshold(self, flight_bytes: int) -> int:  # noqa: ARG002 (Linux reduces the window, not the bytes in flight)
        return max(self._window * _BETA[0] // _BETA[1], 2) * self._segment_bytes
