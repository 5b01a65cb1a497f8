"""CUBIC (RFC 9438), in whole bytes and nanoseconds, so that it is the same on every machine."""

from typing import Final

from typing_extensions import override

from sim_backends.network.tcp.congestion import NewReno
from sim_backends.network.tcp.options import TcpOptions

_NS_PER_S_CUBED: Final = 10**27
# RFC 9438, 4.1 and 4.6: C is 0.4 segments per s^3, beta is 0.7.
_C: Final = 4, 10
_BETA: Final = 7, 10
# 4.3: alpha is 3 (1 - beta) / (1 + beta) = 9 / 17.
_ALPHA: Final = 9, 17
# 4.2: the window opens by at most half in a round trip.
_STEEPEST: Final = 3, 2


def cube_root(number: int) -> int:
    """Return the largest whole number whose cube is not above `number`, which is not negative."""
    if not number:
        return 0
    root = 1 << -(-number.bit_length() // 3)
    # Newton's method from above falls until it is there.
    while (lower := (2 * root + number // (root * root)) // 3) < root:
        root = lower
    return root


class Cubic(NewReno):
    """The window of RFC 9438; slow start as in RFC 5681, without HyStart++ (RFC 9406).

    Args:
        options: As of `NewReno`.
    """

    def __init__(self, options: TcpOptions) -> None:
        super().__init__(options)
        # The plateau (W_max); None where there was no loss, or a timeout since (4.8, 4.10).
        self._highest_bytes: int | None = None
        # The window before the last reduction, whatever made it (cwnd_prior); None before any.
        self._before_bytes: int | None = None
        self._forget()

    @override
    def idled(self, idle_ns: int) -> None:
        """That time does not count (RFC 9438, 5.8)."""
        if self._begun_ns is not None:
            self._begun_ns += idle_ns

    @override
    def lost(self, flight_bytes: int) -> None:
        before_bytes = self.window_bytes
        self._before_bytes = before_bytes
        if self._highest_bytes is not None and before_bytes < self._highest_bytes:
            # Fast convergence (4.7): others have come, so leave room.
            self._highest_bytes = before_bytes * (_BETA[0] + _BETA[1]) // (2 * _BETA[1])
        else:
            self._highest_bytes = before_bytes
        super().lost(flight_bytes)
        self._forget()

    @override
    def timed_out(self, flight_bytes: int, *, again: bool) -> None:
        if not again:
            self._before_bytes = self.window_bytes
        super().timed_out(flight_bytes, again=again)
        self._highest_bytes = None
        self._forget()

    @override
    def restarted(self) -> None:
        super().restarted()
        self._forget()

    def cubic_bytes(self, since_ns: int) -> int:
        """Return W_cubic, `since_ns` after congestion avoidance began (equation 1)."""
        later_ns = since_ns - self._plateau_ns
        return self._origin_bytes + self._segment_bytes * _C[0] * later_ns**3 // (_C[1] * _NS_PER_S_CUBED)

    def _forget(self) -> None:
        self._begun_ns: int | None = None
        self._plateau_ns = 0
        self._origin_bytes = 0
        self._reno_bytes = 0
        self._reno_credit = 0

    def _begin(self, now_ns: int) -> None:
        """Begin congestion avoidance: W_max, K (equation 2) and W_est."""
        window_bytes = self.window_bytes
        self._begun_ns = now_ns
        self._origin_bytes = max(self._highest_bytes or 0, window_bytes)
        below_bytes = self._origin_bytes - window_bytes
        self._plateau_ns = cube_root(below_bytes * _C[1] * _NS_PER_S_CUBED // (_C[0] * self._segment_bytes))
        self._reno_bytes = window_bytes
        if self._before_bytes is None:
            self._before_bytes = window_bytes

    def _avoid(self, now_ns: int, acked_bytes: int, round_trip_ns: int) -> None:
        """See `NewReno`: by the cubic function, or as Reno would where that is more (RFC 9438, 4.2 to 4.5)."""
        if self._begun_ns is None:
            self._begin(now_ns)
            assert self._begun_ns is not None
        window_bytes = self.window_bytes
        since_ns = now_ns - self._begun_ns
        self._follow_reno(acked_bytes)
        if self.cubic_bytes(since_ns) < self._reno_bytes:
            self.window_bytes = max(window_bytes, self._reno_bytes)
            return
        steepest_bytes = window_bytes * _STEEPEST[0] // _STEEPEST[1]
        target_bytes = min(max(self.cubic_bytes(since_ns + round_trip_ns), window_bytes), steepest_bytes)
        self._grow((target_bytes - window_bytes) * acked_bytes)

    def _follow_reno(self, acked_bytes: int) -> None:
        """Open W_est, the window that Reno with CUBIC's reduction would have (equation 4)."""
        assert self._before_bytes is not None
        # Once it is where the window was before, it opens like Reno's own.
        alpha = (1, 1) if self._reno_bytes >= self._before_bytes else _ALPHA
        self._reno_credit += alpha[0] * self._segment_bytes * acked_bytes
        more_bytes, self._reno_credit = divmod(self._reno_credit, alpha[1] * self.window_bytes)
        self._reno_bytes += more_bytes

    def _reduced(self, flight_bytes: int) -> int:
        """See `NewReno`; by beta (equation of 4.6)."""
        return max(flight_bytes * _BETA[0] // _BETA[1], 2 * self._segment_bytes)
