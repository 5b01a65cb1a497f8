"""`error_bounded` (ours): the longest window in which no pair's geometry changes by more than a stated bound.

From their velocities v and the most that these can change, a, two agents displace each other in a time t by at most
|v| t + a t^2 / 2. The window is the time in which that reaches the bound. The network knows where the agents were at
its beginning, so what it takes for a pair's geometry is never wrong by more. While nobody sends and nothing happens
in the network, nobody asks for the geometry, and the window goes on to the last step before something does.

The bound may be stated in dB of path loss. By the log-distance law, 10 n log10(d), a pair at a distance d that comes
nearer by x gains 10 n log10(d / (d - x)), and loses less when it goes away by as much: so b dB allow
x = d (1 - 10^(-b / 10 n)).
"""

import math
from collections.abc import Sequence
from typing import Final

from sim_backends.cosim.policies.base import Pair, PolicyError, Situation, window_ns

_NEAREST_M: Final = 1.0
"""Nearer than this the loss does not change (`radio.propagation.NEAREST_M`)."""


class ErrorBounded:
    """Windows of whole steps of the physics, as many as a bound allows and at least one, in which nothing changes.

    Args:
        bound_m: How far two agents may displace each other within a window, in metres.
        longest_s: What no window exceeds, also where everybody stands.
        bound_db: How much the path loss between two agents in the open may change within a window, in dB; then
            `bound_m` counts for nothing.
        exponent: Of the log-distance law that it is told by.

    Raises:
        PolicyError: One of them is not above 0.
    """

    name = "error_bounded"
    exact = False
    holds_sends = False
    knows_end = False
    holds_arrivals = True

    def __init__(
        self,
        bound_m: float = 0.01,
        longest_s: float = 0.1,
        *,
        bound_db: float | None = None,
        exponent: float = 3.0,
    ) -> None:
        for value, unit in ((bound_m, "m"), (bound_db, "dB"), (exponent, "as exponent")):
            if value is not None and not 0 < value < math.inf:
                raise PolicyError(
                    f"{value:g} {unit} is not above 0", where=self.name, remedy="a bound needs to be above 0"
                )
        self._bound_m = bound_m
        self._share = None if bound_db is None else 1 - 10 ** (-bound_db / (10 * exponent))
        self._longest_ns = window_ns(self.name, longest_s)
        self._pair: Sequence[str] = ()

    def next_window(self, situation: Situation) -> int:
        """See `SyncPolicy.next_window`."""
        allowed_s, self._pair = min(
            ((self._allowed_s(situation, pair), pair) for pair in situation.pairs), default=(math.inf, ())
        )
        next_ns = situation.next_ns
        idle_ns = math.inf if next_ns is None else next_ns - situation.now_ns
        # Windows begin and end at whole steps, so that in one of a single step nothing changes.
        steps = math.floor(min(max(allowed_s * 1e9, idle_ns), self._longest_ns) / situation.physics_step_ns)
        return situation.now_ns + max(steps, 1) * situation.physics_step_ns

    @property
    def decided_by(self) -> str:
        """The pair that could reach the bound first in the last window; see `SyncPolicy`."""
        return " and ".join(self._pair)

    def _allowed_s(self, situation: Situation, pair: Pair) -> float:
        one, other = (situation.states[name] for name in pair)
        bound_m = self._bound_m
        if self._share is not None:
            bound_m = self._share * max(math.dist(one.position_m, other.position_m), _NEAREST_M)
        speed_m_s = math.dist(one.velocity_m_s, other.velocity_m_s)
        limit_m_s2 = sum(situation.limits_m_s2[name] for name in pair)
        # The positive root of a t^2 / 2 + v t = bound, in the form that loses no digits where a is small.
        root_m_s = math.sqrt(speed_m_s**2 + 2 * limit_m_s2 * bound_m)
        return 2 * bound_m / (speed_m_s + root_m_s) if root_m_s else math.inf
