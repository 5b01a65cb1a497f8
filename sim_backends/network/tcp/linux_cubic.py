"""Linux's CUBIC (`net/ipv4/tcp_cubic.c`, Linux 4.x to 6.x), which robots run.

It differs from RFC 9438 (`cubic`) in three ways that matter on lossy links. Its estimate of Reno's window never opens
faster than 8/15 of a segment per round trip. Windows are whole segments. The rate of growth is computed again only
when the window has changed or 1/32 s has passed.
"""

from typing import ClassVar, Final

from sim_backends.network.tcp.congestion import NewReno
from sim_backends.network.tcp.cubic import cube_root
from sim_backends.network.tcp.options import TcpOptions

_NS_PER_S_CUBED: Final = 10**27
# bic_scale 41: C is 410 / 1024 segments per s^3.
_C: Final = 410, 1024
# beta 717 of 1024.
_BETA: Final = 717, 1024
# beta_scale: Reno's window grows by a segment per 15/8 of the window that is acknowledged.
_RENO: Final = 15, 8
# The rate of growth is computed anew after HZ / 32, unless the window changed.
_UPDATE_NS: Final = 1_000_000_000 // 32
# The window grows by a segment per this many segments acknowledged: at least, and at most where no loss was seen yet.
_FASTEST: Final = 2
_SLOWEST_UNKNOWN: Final = 20
# The same at and above the target, as a multiple of the window.
_SLOWEST: Final = 100


class LinuxCubic(NewReno):
    """The window of Linux's CUBIC; slow start as in RFC 5681, without HyStart.

    Args:
        options: Segments, and how the window begins and opens.

    Attributes:
        reduces_in_recovery: See `NewReno`; Linux does not (`tcp_enter_loss`).
    """

    reduces_in_recovery: ClassVar[bool] = False

    def __init__(self, options: TcpOptions) -> None:
        super().__init__(options)
        # In segments: the window at the last loss (W_max), 0 where there was none or a timeout since.
        self._highest = 0
        self._shortest_round_trip_ns: int | None = None
        self._restart_epoch()

    def acknowledged(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:
        """Open the window, see `NewReno.acknowledged`; the shortest round trip is kept (delay_min)."""
        shortest_ns = self._shortest_round_trip_ns
        self._shortest_round_trip_ns = round_trip_ns if shortest_ns is None else min(shortest_ns, round_trip_ns)
        super().acknowledged(now_ns, acked_bytes, round_trip_ns)

    def idled(self, idle_ns: int) -> None:
        """Leave time without a full window out of the epoch."""
        if self._epoch_ns is not None:
            self._epoch_ns += idle_ns

    def lost(self, flight_bytes: int) -> None:
        """Close the window after a loss, and begin a new epoch (bictcp_recalc_ssthresh)."""
        window = self._window
        # Fast convergence: leave room for flows that are new.
        falls = window < self._highest
        self._highest = window * (_BETA[0] + _BETA[1]) // (2 * _BETA[1]) if falls else window
        super().lost(flight_bytes)
        self._restart_epoch()

    def timed_out(self, flight_bytes: int, *, again: bool) -> None:
        """Close the window after a timeout, and forget what was known of the path (bictcp_reset)."""
        super().timed_out(flight_bytes, again=again)
        self._highest = 0
        self._shortest_round_trip_ns = None
        self._restart_epoch()

    @property
    def _window(self) -> int:
        """The window in whole segments."""
        return self.window_bytes // self._segment_bytes

    def _restart_epoch(self) -> None:
        self._epoch_ns: int | None = None
        self._plateau_ns = 0
        self._origin = 0
        self._reno = 0
        self._reno_acked_bytes = 0
        self._per_segment = 0
        self._updated_ns = 0
        self._updated_window = 0

    def _avoid(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:  # noqa: ARG002 (the shortest counts)
        self._reno_acked_bytes += acked_bytes
        if self._window != self._updated_window or now_ns - self._updated_ns > _UPDATE_NS:
            self._update(now_ns, acked_bytes)
        needed_bytes = self._per_segment * self._segment_bytes
        if self._credit >= needed_bytes:
            # What was acknowledged while the window opened more slowly counts as one segment (tcp_cong_avoid_ai).
            self._credit = 0
            self.window_bytes += self._segment_bytes
        self._credit += acked_bytes
        more, self._credit = divmod(self._credit, needed_bytes)
        self.window_bytes += more * self._segment_bytes

    def _update(self, now_ns: int, acked_bytes: int) -> None:
        """Compute how many segments must be acknowledged for one that the window grows (bictcp_update)."""
        window = self._window
        self._updated_window, self._updated_ns = window, now_ns
        if self._epoch_ns is None:
            self._begin(now_ns, acked_bytes)
        target = self._target(now_ns)
        per_segment = window // (target - window) if target > window else _SLOWEST * window
        if not self._highest:
            per_segment = min(per_segment, _SLOWEST_UNKNOWN)
        reno_step_bytes = window * self._segment_bytes * _RENO[0] // _RENO[1]
        grown = max(self._reno_acked_bytes - 1, 0) // reno_step_bytes
        self._reno += grown
        self._reno_acked_bytes -= grown * reno_step_bytes
        if self._reno > window:
            per_segment = min(per_segment, window // (self._reno - window))
        self._per_segment = max(per_segment, _FASTEST)

    def _begin(self, now_ns: int, acked_bytes: int) -> None:
        """Begin an epoch: W_max, and when the window shall be there again (K)."""
        window = self._window
        self._epoch_ns = now_ns
        self._reno, self._reno_acked_bytes = window, acked_bytes
        self._origin = max(self._highest, window)
        self._plateau_ns = cube_root((self._origin - window) * _C[1] * _NS_PER_S_CUBED // _C[0])

    def _target(self, now_ns: int) -> int:
        """Return the cubic function a round trip from now, in segments."""
        assert self._epoch_ns is not None
        since_ns = now_ns - self._epoch_ns + (self._shortest_round_trip_ns or 0)
        beyond_ns = since_ns - self._plateau_ns
        change = _C[0] * abs(beyond_ns) ** 3 // (_C[1] * _NS_PER_S_CUBED)
        return self._origin - change if beyond_ns < 0 else self._origin + change

    def _reduced(self, flight_bytes: int) -> int:  # noqa: ARG002 (Linux reduces the window, not what is under way)
        return max(self._window * _BETA[0] // _BETA[1], 2) * self._segment_bytes
