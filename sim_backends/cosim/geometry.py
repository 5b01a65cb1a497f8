"""The agents whose positions the network uses, and the errors of these positions.

The fate of a packet depends on the positions of its sender, its receiver, a relay that forwards it, a jammer, and
every other agent that transmits on the channel. Only their relative positions matter.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import combinations

from fieldkit.core.model import Vector
from sim_backends.cosim.run import Fate
from sim_backends.world.motion import STILL, State


def transmitters(network: object) -> tuple[str, ...]:
    """Return the agents that forward or interfere in a network, in addition to those that send and receive.

    They are the value of the network's optional attribute `transmitters`.
    """
    names: Iterable[str] = getattr(network, "transmitters", ())
    return tuple(sorted(names))


def fixed_emitters_m(network: object) -> tuple[Vector, ...]:
    """Return the positions of sources of interference that are not agents: the network's optional attribute."""
    return tuple(getattr(network, "fixed_emitters_m", ()))


def position_error_m(fate: Fate) -> float:
    """Return the largest error, in metres, of the relative positions that the network assumed for a packet.

    The positions are those of at least sender and receiver, at the time of sending.
    """
    if fate.position_error_m is not None:
        return fate.position_error_m
    return _max_distance_m(_offsets_m(fate.assumed, fate.true))


def max_position_error_m(
    assumed: Mapping[str, State], true: Sequence[State], names: Collection[str], *, has_fixed_emitters: bool
) -> float:
    """Return the largest error of the network's relative position of two agents.

    Args:
        assumed: States of the agents that the network assumes.
        true: True states of the agents in `names`, in the same order.
        names: The agents to include.
        has_fixed_emitters: True to include a point that never moves, too.
    """
    offsets_m = _offsets_m([assumed[name] for name in names], true)
    return _max_distance_m([*offsets_m, STILL] if has_fixed_emitters else offsets_m)


def _offsets_m(assumed: Iterable[State], true: Iterable[State]) -> list[Vector]:
    """Return the error vector of each assumed position."""
    offsets_m = []
    for assumed_state, true_state in zip(assumed, true, strict=True):
        (e, n, u), (true_e, true_n, true_u) = assumed_state.position_m, true_state.position_m
        offsets_m.append((e - true_e, n - true_n, u - true_u))
    return offsets_m


def _max_distance_m(offsets_m: Sequence[Vector]) -> float:
    return max((math.dist(first, second) for first, second in combinations(offsets_m, 2)), default=0.0)
