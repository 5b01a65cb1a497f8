"""`velocity_aware`: the paper's rule made safe, with the magnitude of the relative velocity and with limits."""

import math
from collections.abc import Sequence

from sim_backends.cosim.policies.base import Situation, window_ns
from sim_backends.cosim.policies.velocity_aware_raw import NS_PER_M_S
from sim_backends.cosim.windows import Windows


class VelocityAware:
    """The smallest window that `w + |Vp - Vs| / 1000` gives for any pair, at least a step of the physics.

    Args:
        window_s: w, in seconds.
        longest_s: Longest window, in seconds.

    Raises:
        PolicyError: One of them is not a positive time.
    """

    name = "velocity_aware"
    exact = False
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def __init__(self, window_s: float = 0.001, longest_s: float = 0.1) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._longest_ns = window_ns(self.name, longest_s)
        self._windows = Windows()
        self._pair: Sequence[str] = ()

    def next_window(self, situation: Situation) -> int:
        """Return the end of the next window."""
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
        """The pair with the lowest relative velocity in the last window."""
        return " and ".join(self._pair)
