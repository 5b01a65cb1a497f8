"""`error_bounded` (ours): the longest window in which the network is never wrong about a pair by more than a bound.

The network lets agents move on at the velocity that they had when the window began, as simulators of many vehicles do
between updates (dead reckoning, IEEE Std 1278.1, annex E). Physics and programs go ahead of it: whatever arrives in
the window counts from its end, so nothing that they do in it depends on the network. A pair is off by x then, the
distance between where one is as seen from the other and where the network takes it to be, and parts from that at a
speed v, which the most that velocities change, a, makes grow: in a time t it is off by at most x + v t + a t^2 / 2.
Before that can come to the bound, one looks again; where not even a step of the physics is left, the window ends. So
the bound holds whatever bodies do, and none of it is kept back for what they could have done and did not ("send on
delta": Miskowicz, Sensors 6, 49, 2006).

While nobody sends and nothing happens in the network, nobody asks for the geometry, and the window goes on to the
last step before something does. Where a network cannot let agents move on they stand for it, and x is the way itself.

The bound may be stated in dB of path loss. By the log-distance law, 10 n log10(d), a pair that is taken to be d apart
and is nearer by x gains 10 n log10(d / (d - x)), and loses less when it is farther by as much: so b dB allow
x = d (1 - 10^(-b / 10 n)), which falls no faster than the network lets the pair come nearer.
"""

import math
from collections.abc import Sequence
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.cosim.policies.base import Pair, PolicyError, Situation, window_ns
from sim_backends.world.motion import STILL, State

_NEAREST_M: Final = 1.0
"""Nearer than this the loss does not change (`radio.propagation.NEAREST_M`)."""


class ErrorBounded:
    """Windows of whole steps of the physics, as many as a bound allows and at least one, in which nothing changes.

    Args:
        bound_m: By how much the network may be wrong about where two agents are to each other, in metres.
        longest_s: What no window exceeds, also where everybody stands.
        bound_db: By how much it may be wrong about the path loss between two agents in the open, in dB; then
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
        self._share = 0.0 if bound_db is None else 1 - 10 ** (-bound_db / (10 * exponent))
        self._longest_ns = window_ns(self.name, longest_s)
        self._began_ns = 0
        self._pair: Sequence[str] = ()

    def next_window(self, situation: Situation) -> int:
        """See `SyncPolicy.next_window`."""
        self._began_ns = situation.now_ns
        # Windows begin and end at whole steps, so that in one of a single step nothing changes.
        return max(self.goes_on(situation), situation.now_ns + situation.physics_step_ns)

    def goes_on(self, situation: Situation) -> int:
        """See `LookingAhead.goes_on`."""
        allowed_s, self._pair = min(
            ((self._allowed_s(situation, pair), pair) for pair in situation.pairs), default=(math.inf, ())
        )
        now_ns, use_ns = situation.now_ns, situation.next_use_ns
        unasked_ns = math.inf if use_ns is None else use_ns - now_ns
        most_ns = self._began_ns + self._longest_ns - now_ns
        steps = math.floor(min(max(allowed_s * 1e9, unasked_ns), most_ns) / situation.physics_step_ns)
        return now_ns + max(steps, 0) * situation.physics_step_ns

    @property
    def decided_by(self) -> str:
        """The pair that could reach the bound first in the last window; see `SyncPolicy`."""
        return " and ".join(self._pair)

    def _allowed_s(self, situation: Situation, pair: Pair) -> float:
        """Return for how long from now on the network is certainly not wrong about a pair by more than the bound."""
        place_m, velocity_m_s = _between(*(situation.states[name] for name in pair))
        known_m, known_m_s = place_m, STILL
        if situation.known is not None:
            known_m, known_m_s = _between(*(situation.known[name] for name in pair))
        off_m, parts_m_s = math.dist(place_m, known_m), math.dist(velocity_m_s, known_m_s)
        bound_m = self._bound_m
        if self._share:
            bound_m = self._share * max(math.hypot(*known_m), _NEAREST_M)
            parts_m_s += self._share * math.hypot(*known_m_s)
        left_m = bound_m - off_m
        if left_m <= 0:
            return 0.0
        limit_m_s2 = sum(situation.limits_m_s2[name] for name in pair)
        # The positive root of a t^2 / 2 + v t = left, in the form that loses no digits where a is small.
        root_m_s = math.sqrt(parts_m_s**2 + 2 * limit_m_s2 * left_m)
        return 2 * left_m / (parts_m_s + root_m_s) if root_m_s else math.inf


def _between(one: State, other: State) -> tuple[Vector, Vector]:
    """Return where the other is, and how it moves, as seen from the one."""
    (e, n, u), (v_e, v_n, v_u) = one.position_m, one.velocity_m_s
    (to_e, to_n, to_u), (to_v_e, to_v_n, to_v_u) = other.position_m, other.velocity_m_s
    return (to_e - e, to_n - n, to_u - u), (to_v_e - v_e, to_v_n - v_n, to_v_u - v_u)
