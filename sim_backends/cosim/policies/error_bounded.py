"""The sync policy `error_bounded`, whose windows are as long as a bound on position errors of the network allows.

The paper (cited in docs/index.md), which proposes the velocity-aware policies, has no such policy.

The network extrapolates the agents at the velocities that they had at the beginning of the window, as simulators of
many vehicles do between updates (dead reckoning, IEEE Std 1278.1, annex E). Physics and programs advance ahead of the
network: arrivals count from the end of the window, so nothing that physics and programs do in the window depends on
the network. At the time that physics and programs have reached, a pair of agents has an error x: the distance between
the true relative position of the two agents and their relative position in the network. This error grows at a speed
v, which changes by at most the acceleration limit a: after a time t, the error is at most x + v t + a t^2 / 2. Before
the error can reach the bound, the policy evaluates the errors again; if less than one physics step remains, the
window ends. The bound is therefore kept for any motion, and the windows are not shortened for motions that were
possible but did not occur ("send on delta": Miskowicz, Sensors 6, 49, 2006).

The policy examines the pairs of all agents that send, receive, forward or interfere. A bound in metres adds the pairs
of each agent and a fixed point on the ground, so that the bound also applies to the absolute position of the agent. A
bound in dB adds the pairs of each agent and a fixed source of interference.

The network extrapolates in steps, but the trajectory is continuous: with an assumed relative speed u and a step q,
the error grows by u q between two steps. The step is the physics step if u q is at most an eighth of the
bound; otherwise it is shorter.

While no program sends and the network has no events, positions are not used, and the window extends to the last step
at or before the next event, or to its maximum length. If a network cannot extrapolate, it assumes that agents do not
move. Then x is the distance that they have moved relative to each other. If they can move farther than the bound in
one physics step, the policy raises an error.

The bound may be given in dB of path loss. By the log-distance law, the path loss at a distance d is a constant plus
10 n log10(d). If two agents with the assumed distance d are nearer by x, their path loss is lower by
10 n log10(d / (d - x)); if they are farther by x, the change is smaller. A bound of b dB therefore allows an error
x = d (1 - 10^(-b / (10 n))), which decreases no faster than the assumed distance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.model import Vector
from sim_backends.cosim.policies.sync_policy import Pair, PolicyError, Situation, window_ns
from sim_backends.world.motion import STILL, State

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

_NEAREST_M: Final = 1.0
"""At smaller distances the path loss is constant (`radio.propagation.path_loss.NEAREST_M`)."""
_STEP_SHARE: Final = 1 / 8
"""Share of the bound that is used for the motion between two steps of dead reckoning."""
_GROUND_M: Final = (STILL,)
"""A fixed point: a position relative to it has the error of the absolute position."""


class ErrorBounded:
    """Each window has as many physics steps as a bound on position errors allows, at least one.

    Args:
        bound_m: Largest error of the network's relative position of two agents, in metres.
        longest_s: Length of the longest window, if that is at least a physics step; it also applies if no agent
            moves.
        bound_db: Largest error of the path loss in free line of sight, between two agents, or between an agent and a
            fixed source of interference, in dB; it replaces `bound_m`.
        exponent: Exponent of the log-distance law for `bound_db`.

    Raises:
        PolicyError: One of these values is not a finite number above 0.
    """

    name = "error_bounded"
    exact = False
    defers_sends = False
    uses_end_states = False
    defers_arrivals = True

    def __init__(
        self,
        bound_m: float = 0.01,
        longest_s: float = 0.1,
        *,
        bound_db: float | None = None,
        exponent: float = 3.0,
    ) -> None:
        for quantity, value, unit in (
            ("bound", bound_m, " m"),
            ("bound", bound_db, " dB"),
            ("exponent", exponent, ""),
        ):
            if value is not None and not 0 < value < math.inf:
                raise PolicyError(
                    f"the {quantity} of {value:g}{unit} is not a finite number above 0",
                    where=self.name,
                    remedy="use for example a bound of 0.01 m, and an exponent of 3",
                )
        self._bound_m = bound_m
        # The bound as a share of the assumed distance; 0 for a bound in metres.
        self._share = 0.0 if bound_db is None else 1 - 10 ** (-bound_db / (10 * exponent))
        self._longest_ns = window_ns(self.name, longest_s)
        self._begin_ns = 0
        self._reckoning_step_ns = 1
        self._decided_by = ""

    def next_window(self, situation: Situation) -> int:
        """Return the end of the next window.

        Raises:
            PolicyError: The network does not extrapolate, positions are used within the next step, and the motion in
                that step exceeds the bound.
        """
        self._begin_ns = now_ns = situation.now_ns
        end_ns = self.extended_end_ns(situation)
        if end_ns > now_ns:
            return end_ns
        # The window ends at the next whole step, even if an error may reach its bound before: there are no newer
        # states before that step.
        end_ns = _step_begin_ns(situation) + situation.physics_step_ns
        use_ns = situation.next_use_ns
        if use_ns is not None and use_ns < end_ns:
            self._check_step(situation)
        return end_ns

    def reckoning_step_ns(self, situation: Situation) -> int:
        """Return the step of dead reckoning.

        It is the physics step, or a shorter step if the motion in a physics step would use too much of the bound.
        """
        pairs = self._pairs(situation)
        with np.errstate(divide="ignore"):
            longest_s = float(np.min(_STEP_SHARE * pairs.bounds_m / pairs.assumed_m_s, initial=math.inf))
        step_ns = situation.physics_step_ns
        # The step need not be shorter than 1 ns, because all times are whole nanoseconds.
        self._reckoning_step_ns = step_ns if longest_s * 1e9 >= step_ns else max(math.floor(longest_s * 1e9), 1)
        return self._reckoning_step_ns

    def extended_end_ns(self, situation: Situation) -> int:
        """Return the last physics step up to which no error can exceed its bound, or no position is used.

        It is within the longest window; if there is no such step after `situation.now_ns`, return `situation.now_ns`.
        """
        pairs = self._pairs(situation)
        # A step of 1 ns is the resolution of time, so the extrapolation is then as good as continuous.
        allowed_s = pairs.allowed_s(0.0 if self._reckoning_step_ns == 1 else self._reckoning_step_ns / 1e9)
        first_pair = int(np.argmin(allowed_s)) if len(allowed_s) else None
        self._decided_by = "" if first_pair is None else pairs.name(first_pair)
        step_ns, begin_ns, use_ns = situation.physics_step_ns, _step_begin_ns(situation), situation.next_use_ns
        allowed_ns = math.inf if first_pair is None else float(allowed_s[first_pair]) * 1e9
        until_use_ns = math.inf if use_ns is None else use_ns - begin_ns
        longest_ns = self._begin_ns + self._longest_ns - begin_ns
        steps = math.floor(min(max(allowed_ns, until_use_ns), longest_ns) / step_ns)
        return max(begin_ns + steps * step_ns, situation.now_ns)

    @property
    def decided_by(self) -> str:
        """The pair or agent whose error could reach the bound first in the last window; empty without agents."""
        return self._decided_by

    def _check_step(self, situation: Situation) -> None:
        """Check that no error exceeds its bound in the next physics step, which is the shortest window.

        Raises:
            PolicyError: An error may exceed its bound.
        """
        pairs, step_s = self._pairs(situation), situation.physics_step_ns / 1e9
        errors_m = pairs.error_rates_m_s * step_s
        if not (errors_m > pairs.bounds_m).any():
            return
        worst_pair = int(np.argmax(errors_m - pairs.bounds_m))
        raise PolicyError(
            f"this network does not extrapolate, and in one physics step, {step_s:g} s, the position error of "
            f"{pairs.name(worst_pair)} may reach {errors_m[worst_pair]:.3g} m; the bound is "
            f"{pairs.bounds_m[worst_pair]:.3g} m",
            where=f"{self.name} at {situation.now_ns / 1e9:g} s",
            remedy="use a larger bound, a shorter physics step, or a network that extrapolates",
        )

    def _pairs(self, situation: Situation) -> "_Pairs":
        """Return the errors, speeds and bounds of all pairs of agents that the policy examines."""
        fixed_m = situation.fixed_emitters_m if self._share else _GROUND_M
        names, first, second = _pair_rows(tuple(situation.pairs), situation.other_agents, len(fixed_m))
        states = [situation.states[name] for name in names]
        assumed_states = [State(state.position_m) for state in states]
        if situation.assumed_states is not None:
            assumed_states = [situation.assumed_states[name] for name in names]
        positions_m, velocities_m_s = _arrays(states, fixed_m)
        assumed_m, assumed_m_s = _arrays(assumed_states, fixed_m)
        # The physics federate may have no limit for an agent that appeared during the run.
        limits_m_s2 = np.array(
            [*(situation.limits_m_s2.get(name, math.inf) for name in names), *(0.0 for _ in fixed_m)]
        )
        bounds_m = np.full(len(first), self._bound_m)
        speeds_m_s = _norms(assumed_m_s[first] - assumed_m_s[second])
        error_rates_m_s = _norms((velocities_m_s - assumed_m_s)[first] - (velocities_m_s - assumed_m_s)[second])
        if self._share:
            bounds_m = self._share * np.maximum(_norms(assumed_m[first] - assumed_m[second]), _NEAREST_M)
        return _Pairs(
            names,
            first,
            second,
            errors_m=_norms((positions_m - assumed_m)[first] - (positions_m - assumed_m)[second]),
            error_rates_m_s=error_rates_m_s,
            assumed_m_s=speeds_m_s,
            limits_m_s2=limits_m_s2[first] + limits_m_s2[second],
            bounds_m=bounds_m,
            bound_rates_m_s=self._share * speeds_m_s,
        )


@dataclass(frozen=True)
class _Pairs:
    """Pairs of agents, or of an agent and a fixed point: arrays with one value per pair.

    Attributes:
        names: The agents.
        first: Row of the first agent of each pair.
        second: Row of the second agent of each pair; a row beyond `names` is a fixed point.
        errors_m: Current error of the assumed relative position.
        error_rates_m_s: Speed at which that error grows.
        assumed_m_s: Assumed relative speed.
        limits_m_s2: Largest change of their relative velocity per second.
        bounds_m: Largest allowed error.
        bound_rates_m_s: Largest speed at which the bound may decrease.
    """

    names: Sequence[str]
    first: Integers
    second: Integers
    errors_m: Floats
    error_rates_m_s: Floats
    assumed_m_s: Floats
    limits_m_s2: Floats
    bounds_m: Floats
    bound_rates_m_s: Floats

    def name(self, pair: int) -> str:
        """Return the names of the agents of a pair."""
        rows = int(self.first[pair]), int(self.second[pair])
        return " and ".join(self.names[row] for row in rows if row < len(self.names))

    def allowed_s(self, step_s: float) -> Floats:
        """Return the time for which the error of each pair certainly stays within its bound.

        Args:
            step_s: Step of dead reckoning; 0 if the extrapolation is continuous.
        """
        margin_m = self.bounds_m - self.errors_m - self.assumed_m_s * step_s
        rates_m_s = self.error_rates_m_s + self.bound_rates_m_s
        with np.errstate(divide="ignore", invalid="ignore"):
            # The positive root of a t^2 / 2 + v t = margin, in the form that loses no digits if a is small.
            allowed_s = 2 * margin_m / (rates_m_s + np.sqrt(rates_m_s**2 + 2 * self.limits_m_s2 * margin_m))
        positive_s: Floats = np.where(margin_m > 0, allowed_s, 0.0)
        return positive_s


@lru_cache(maxsize=64)
def _pair_rows(
    pairs: tuple[Pair, ...], other_agents: tuple[str, ...], fixed_count: int
) -> tuple[Sequence[str], Integers, Integers]:
    """Return the active agents, and the rows of both members of each pair.

    The rows of the fixed points follow the rows of the agents.
    """
    names = sorted({*other_agents, *(name for pair in pairs for name in pair)})
    first, second = np.triu_indices(len(names) + fixed_count, k=1)
    with_agent = first < len(names)
    return names, first[with_agent], second[with_agent]


def _arrays(states: Sequence[State], fixed_m: Sequence[Vector]) -> tuple[Floats, Floats]:
    """Return positions and velocities of agents and fixed points, each of shape (agents and fixed points, 3)."""
    positions_m = np.array([*(state.position_m for state in states), *fixed_m], np.float64).reshape(-1, 3)
    velocities_m_s = np.array([*(state.velocity_m_s for state in states), *(STILL for _ in fixed_m)], np.float64)
    return positions_m, velocities_m_s.reshape(-1, 3)


def _norms(vectors: Floats) -> Floats:
    """Return the length of each vector, one per row."""
    lengths: Floats = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))
    return lengths


def _step_begin_ns(situation: Situation) -> int:
    return situation.now_ns // situation.physics_step_ns * situation.physics_step_ns
