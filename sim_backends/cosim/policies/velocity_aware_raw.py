"""`velocity_aware_raw` (the paper, algorithm 1, as printed): `w_a = w + (Vp - Vs) / 1000`.

Vp and Vs are the speeds of publisher and subscriber in m/s; w and w_a are in seconds. So each m/s by which the
subscriber is faster shortens the window by 1 ms. The rule is signed: with the paper's w of 1 ms, time stops if the
subscriber is 1 m/s faster, and would run backwards if it is faster than that.
"""

import math

from sim_backends.cosim.policies.base import PolicyError, Situation, window_ns
from sim_backends.cosim.windows import Windows

NS_PER_M_S = 1e6
"""Change of the window per m/s: 1/1000 s."""


class VelocityAwareRaw:
    """The smallest window that the rule gives for any pair, from publisher to subscriber.

    Args:
        window_s: w, in seconds.

    Raises:
        PolicyError: It is not a positive time.
    """

    name = "velocity_aware_raw"
    exact = False
    defers_sends = False
    uses_end_states = True
    defers_arrivals = False

    def __init__(self, window_s: float = 0.001) -> None:
        self._window_ns = window_ns(self.name, window_s)
        self._windows = Windows()
        self._pair = "", ""

    def next_window(self, situation: Situation) -> int:
        """Return the end of the next window.

        Raises:
            PolicyError: The window that the rule gives for a pair is not a positive time.
        """
        speeds_m_s = {name: math.hypot(*state.velocity_m_s) for name, state in situation.states.items()}
        length_ns, publisher, subscriber = min(
            (
                (
                    self._window_ns + (speeds_m_s[publisher] - speeds_m_s[subscriber]) * NS_PER_M_S,
                    publisher,
                    subscriber,
                )
                for publisher, subscriber in situation.pairs
            ),
            default=(self._window_ns, "", ""),
        )
        if length_ns < 1:
            raise PolicyError(
                f"{publisher} publishes at {speeds_m_s[publisher]:g} m/s to {subscriber} at "
                f"{speeds_m_s[subscriber]:g} m/s: w + (Vp - Vs)/1000 is {length_ns / 1e9:g} s, so that time "
                f"{'stops' if length_ns >= 0 else 'runs backwards'}",
                where=f"{self.name} at {situation.now_ns / 1e9:g} s",
                remedy="use velocity_aware, which is the rule made safe",
            )
        self._pair = publisher, subscriber
        return self._windows.end_ns(situation.now_ns, length_ns)

    @property
    def decided_by(self) -> str:
        """Publisher and subscriber with the shortest window of the last one."""
        return " to ".join(filter(None, self._pair))
