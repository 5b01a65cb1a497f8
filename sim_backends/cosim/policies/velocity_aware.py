"""`velocity_aware`: the paper's rule made safe, with the magnitude of the relative velocity and within bounds."""

import math
from collections.abc import Sequence

from sim_backends.cosim.policies.base import Situation, window_ns
from sim_backends.cosim.policies.velocity_aware_raw import NS_PER_M_S
from sim_backends.cosim.windows import Windows


class VelocityAware:
    """The smallest window that `w + |Vp - Vs| / 1000` gives for any pair, at least a step of the physics.

    Args:
        window_s: w, in seconds.
        longest_s: What no window exceeds.

    Raises:
        PolicyError: One of them is no positive time.
    """

    name = "velocity_aware"
    exact = False
    holds_sends = False
    knows_end = True
    holds_arrivals = False

    def __init__(self, window_s: float = 0.001, longest_s: float = 0.1) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._longest_ns = window_ns(self.name, longest_s)
        self._windows = Windows()
        self._pair: Sequence[str] = ()

    def next_window(self, situation: Situation) -> int:
        """See `SyncPolicy.next_window`."""
        states = situation.states
        slowest_m_s, self._pair = min(
            (
                (math.dist(states[pair[0]].velocity_m_s, states[pair[1]].velocity_m_s), pair)
                for pair in situation.pairs
            ),
            default=(math.inf, ()),
        )
        length_ns = min(self._window_ns + slowest_m_s * NS_PER_M_S, self._longest_ns)
        return self._windows.end_ns(situation.now_ns, max(length_ns, situation.physics_step_ns))

    @property
    def decided_by(self) -> str:
        """The pair with the lowest relative velocity in the last window; see `SyncPolicy`."""
        return " and ".join(self._pair)
