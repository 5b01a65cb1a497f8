"""`error_bounded` (ours): the longest window in which the network is wrong about no place by more than a bound.

The network lets agents move on at the velocity that they had when the window began, as simulators of many vehicles do
between updates (dead reckoning, IEEE Std 1278.1, annex E). Physics and programs go ahead of it: whatever arrives in
the window counts from its end, so nothing that they do in it depends on the network. A pair is off by x then, the
distance between where one is as seen from the other and where the network takes it to be, and parts from that at a
speed v, which the most that velocities change, a, makes grow: in a time t it is off by at most x + v t + a t^2 / 2.
Before that can come to the bound, one looks again; where not even a step of the physics is left, the window ends. So
the bound holds whatever bodies do, and none of it is kept back for what they could have done and did not ("send on
delta": Miskowicz, Sensors 6, 49, 2006).

Pairs are those of all agents that send, receive, forward or interfere. In metres, the ground is one more of them, so
that the bound is also one on each agent's own place; in dB, what interferes from a fixed place is.

Agents move on by steps for the network, and the trajectory is continuous: between two steps it parts by u q at a
known relative speed u and a step q. The step is the physics' own where that takes an eighth of the bound at most,
else it is shorter.

While nobody sends and nothing happens in the network, nobody asks for the geometry, and the window goes on to the
last step before something does. Where a network cannot let agents move on they stand for it, and x is the way itself;
if one step of the physics takes them farther than the bound, the bound cannot be kept, and the policy says so.

The bound may be stated in dB of path loss. By the log-distance law, 10 n log10(d), a pair that is taken to be d apart
and is nearer by x gains 10 n log10(d / (d - x)), and loses less when it is farther by as much: so b dB allow
x = d (1 - 10^(-b / 10 n)), which falls no faster than the network lets the pair come nearer.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.model import Vector
from sim_backends.cosim.policies.base import Pair, PolicyError, Situation, window_ns
from sim_backends.world.motion import STILL, State

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

_NEAREST_M: Final = 1.0
"""Nearer than this the loss does not change (`radio.propagation.NEAREST_M`)."""
_HELD_SHARE: Final = 1 / 8
"""Of the bound, for what agents move between two steps of dead reckoning."""
_GROUND_M: Final = (STILL,)
"""A fixed place: a vector from it is wrong by as much as the place at its other end."""


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
        self._moves_every_ns = 1
        self._decided_by = ""

    def next_window(self, situation: Situation) -> int:
        """See `SyncPolicy.next_window`.

        Raises:
            PolicyError: Agents stand for the network, somebody asks for places within the next step, and that takes
                a pair farther than the bound.
        """
        self._began_ns = now_ns = situation.now_ns
        end_ns = self.goes_on(situation)
        if end_ns > now_ns:
            return end_ns
        # At least to the next whole step: dead reckoning is as right in it as states at steps can be.
        end_ns = _step_begin_ns(situation) + situation.physics_step_ns
        use_ns = situation.next_use_ns
        if use_ns is not None and use_ns < end_ns:
            self._check_step(situation)
        return end_ns

    def moves_on_every_ns(self, situation: Situation) -> int:
        """See `LookingAhead.moves_on_every_ns`."""
        pairs = self._pairs(situation)
        with np.errstate(divide="ignore"):
            most_s = float(np.min(_HELD_SHARE * pairs.bounds_m / pairs.known_m_s, initial=math.inf))
        step_ns = situation.physics_step_ns
        # Times are whole nanoseconds, so that nothing happens between two of them.
        self._moves_every_ns = step_ns if most_s * 1e9 >= step_ns else max(math.floor(most_s * 1e9), 1)
        return self._moves_every_ns

    def goes_on(self, situation: Situation) -> int:
        """See `LookingAhead.goes_on`."""
        pairs = self._pairs(situation)
        allowed_s = pairs.allowed_s(0.0 if self._moves_every_ns == 1 else self._moves_every_ns / 1e9)
        first = int(np.argmin(allowed_s)) if len(allowed_s) else None
        self._decided_by = "" if first is None else pairs.name(first)
        step_ns, begin_ns, use_ns = situation.physics_step_ns, _step_begin_ns(situation), situation.next_use_ns
        least_s = math.inf if first is None else float(allowed_s[first])
        unasked_ns = math.inf if use_ns is None else use_ns - begin_ns
        most_ns = self._began_ns + self._longest_ns - begin_ns
        steps = math.floor(min(max(least_s * 1e9, unasked_ns), most_ns) / step_ns)
        return max(begin_ns + steps * step_ns, situation.now_ns)

    @property
    def decided_by(self) -> str:
        """The pair that could reach the bound first in the last window, or the agent that could; see `SyncPolicy`."""
        return self._decided_by

    def _check_step(self, situation: Situation) -> None:
        pairs, step_s = self._pairs(situation), situation.physics_step_ns / 1e9
        off_m = pairs.parts_m_s * step_s
        if not (off_m > pairs.bounds_m).any():
            return
        most = int(np.argmax(off_m - pairs.bounds_m))
        raise PolicyError(
            f"agents stand for this network, and in one step of the physics, {step_s:g} s, {pairs.name(most)} may be "
            f"off by {off_m[most]:.3g} m; the bound is {pairs.bounds_m[most]:.3g} m",
            where=f"{self.name} at {situation.now_ns / 1e9:g} s",
            remedy="take a larger bound or a shorter step of the physics, or let the network extrapolate",
        )

    def _pairs(self, situation: Situation) -> "_Pairs":
        fixed_m = situation.fixed_m if self._share else _GROUND_M
        names, one, other = _ends(tuple(situation.pairs), situation.others, len(fixed_m))
        states = [situation.states[name] for name in names]
        known = [State(state.position_m) for state in states]
        if situation.known is not None:
            known = [situation.known[name] for name in names]
        places_m, velocities_m_s = _rows(states, fixed_m)
        known_m, known_m_s = _rows(known, fixed_m)
        # Of an agent that appeared during the run the physics may tell no limit.
        limits_m_s2 = np.array(
            [*(situation.limits_m_s2.get(name, math.inf) for name in names), *(0.0 for _ in fixed_m)]
        )
        bounds_m = np.full(len(one), self._bound_m)
        speeds_m_s = _norms(known_m_s[one] - known_m_s[other])
        parts_m_s = _norms((velocities_m_s - known_m_s)[one] - (velocities_m_s - known_m_s)[other])
        if self._share:
            bounds_m = self._share * np.maximum(_norms(known_m[one] - known_m[other]), _NEAREST_M)
        return _Pairs(
            names,
            one,
            other,
            off_m=_norms((places_m - known_m)[one] - (places_m - known_m)[other]),
            parts_m_s=parts_m_s,
            known_m_s=speeds_m_s,
            limits_m_s2=limits_m_s2[one] + limits_m_s2[other],
            bounds_m=bounds_m,
            falls_m_s=self._share * speeds_m_s,
        )


@dataclass(frozen=True)
class _Pairs:
    """Pairs of agents, or of an agent and something fixed: arrays with one value for each.

    Attributes:
        names: The agents.
        one: Row of the first of a pair.
        other: Row of the second; one behind `names` is fixed.
        off_m: By how much the network is wrong about the vector between them.
        parts_m_s: How fast that grows.
        known_m_s: How fast they move to each other for the network.
        limits_m_s2: The most that their relative velocity changes per second.
        bounds_m: By how much the network may be wrong.
        falls_m_s: How fast these bounds may fall.
    """

    names: Sequence[str]
    one: Integers
    other: Integers
    off_m: Floats
    parts_m_s: Floats
    known_m_s: Floats
    limits_m_s2: Floats
    bounds_m: Floats
    falls_m_s: Floats

    def name(self, pair: int) -> str:
        """Return the agents of a pair."""
        rows = int(self.one[pair]), int(self.other[pair])
        return " and ".join(self.names[row] for row in rows if row < len(self.names))

    def allowed_s(self, moves_every_s: float) -> Floats:
        """Return for how long the network is certainly not wrong about each by more than its bound.

        Args:
            moves_every_s: Step of dead reckoning; 0 where agents move on at every time.
        """
        left_m = self.bounds_m - self.off_m - self.known_m_s * moves_every_s
        parts_m_s = self.parts_m_s + self.falls_m_s
        with np.errstate(divide="ignore", invalid="ignore"):
            # The positive root of a t^2 / 2 + v t = left, in the form that loses no digits where a is small.
            allowed_s = 2 * left_m / (parts_m_s + np.sqrt(parts_m_s**2 + 2 * self.limits_m_s2 * left_m))
        kept_s: Floats = np.where(left_m > 0, allowed_s, 0.0)
        return kept_s


@lru_cache(maxsize=64)
def _ends(pairs: tuple[Pair, ...], others: tuple[str, ...], fixed: int) -> tuple[Sequence[str], Integers, Integers]:
    """Return the active agents, and the rows of both ends of each pair of them, and of what is fixed behind them."""
    names = sorted({*others, *(name for pair in pairs for name in pair)})
    one, other = np.triu_indices(len(names) + fixed, k=1)
    with_agent = one < len(names)
    return names, one[with_agent], other[with_agent]


def _rows(states: Sequence[State], fixed_m: Sequence[Vector]) -> tuple[Floats, Floats]:
    """Return places and velocities, shape (agents and what is fixed, 3)."""
    places_m = np.array([*(state.position_m for state in states), *fixed_m], np.float64).reshape(-1, 3)
    velocities_m_s = np.array([*(state.velocity_m_s for state in states), *(STILL for _ in fixed_m)], np.float64)
    return places_m, velocities_m_s.reshape(-1, 3)


def _norms(vectors: Floats) -> Floats:
    lengths: Floats = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return lengths


def _step_begin_ns(situation: Situation) -> int:
    return situation.now_ns // situation.physics_step_ns * situation.physics_step_ns
