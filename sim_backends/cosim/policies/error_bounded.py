"""`error_bounded` (ours): the longest window in which no pair's geometry changes by more than a stated bound.

From their velocities v and the most that these can change, a, two agents displace each other in a time t by at most
|v| t + a t^2 / 2. The window is the time in which that reaches the bound. The network knows where the agents were at
its beginning, so what it takes for a pair's geometry is never wrong by more.
"""

import math

from sim_backends.cosim.policies.base import Pair, PolicyError, Situation


class ErrorBounded:
    """Windows of whole steps of the physics, as many as a bound allows and at least one, in which nothing changes.

    Args:
        bound_m: How far two agents may displace each other within a window, in metres.
        longest_s: What no window exceeds, also where everybody stands.

    Raises:
        PolicyError: One of them is not above 0.
    """

    name = "error_bounded"
    exact = False
    holds_sends = False
    knows_end = False
    holds_arrivals = True

    def __init__(self, bound_m: float = 0.01, longest_s: float = 0.1) -> None:
        if not (0 < bound_m < math.inf and 0 < longest_s < math.inf):
            raise PolicyError(f"a bound of {bound_m:g} m and windows of at most {longest_s:g} s need to be above 0")
        self._bound_m = bound_m
        self._longest_ns = longest_s * 1e9

    def next_window(self, situation: Situation) -> int:
        """See `SyncPolicy.next_window`."""
        allowed_s = min((self._allowed_s(situation, pair) for pair in situation.pairs), default=math.inf)
        # Windows begin and end at whole steps, so that in one of a single step nothing changes.
        steps = math.floor(min(allowed_s * 1e9, self._longest_ns) / situation.physics_step_ns)
        return situation.now_ns + max(steps, 1) * situation.physics_step_ns

    def _allowed_s(self, situation: Situation, pair: Pair) -> float:
        one, other = (situation.states[name].velocity_m_s for name in pair)
        speed_m_s = math.dist(one, other)
        limit_m_s2 = sum(situation.limits_m_s2[name] for name in pair)
        # The positive root of a t^2 / 2 + v t = bound, in the form that loses no digits where a is small.
        root_m_s = math.sqrt(speed_m_s**2 + 2 * limit_m_s2 * self._bound_m)
        return 2 * self._bound_m / (speed_m_s + root_m_s) if root_m_s else math.inf
