"""Whose places the network uses, and how wrong it is about them.

A packet's fate depends on the places of its sender and its receiver, of a relay that forwards it, of a jammer, and of
every other agent that transmits on the channel. What counts is where two of them are to each other.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import combinations

from fieldkit.core.model import Vector
from sim_backends.cosim.run import Fate
from sim_backends.world.motion import STILL, State


def transmitting(network: object) -> tuple[str, ...]:
    """Return the agents that a network lets forward or interfere, beside those that send and receive.

    A network names them by an attribute `transmitters`, which may be missing.
    """
    names: Iterable[str] = getattr(network, "transmitters", ())
    return tuple(sorted(names))


def fixed_emitters_m(network: object) -> tuple[Vector, ...]:
    """Return the places of what interferes and is no agent, by an attribute of this name; it may be missing."""
    return tuple(getattr(network, "fixed_emitters_m", ()))


def displaced_m(fate: Fate) -> float:
    """Return how wrong the network was about the places that count for a packet when it was sent, in metres.

    It is the largest error of the vector from one of the agents to another one: of sender and receiver at least.
    """
    return _widest_m(_offsets_m(fate.known, fate.true)) if fate.displaced_m is None else fate.displaced_m


def largest_m(known: Mapping[str, State], true: Sequence[State], names: Collection[str], *, anchored: bool) -> float:
    """Return by how much the network is wrong about where two agents are to each other, the largest.

    Args:
        known: Where the network takes the agents to be.
        true: Where those of `names` are, in their order.
        names: The agents whose places count.
        anchored: Whether something that never moves counts, too.
    """
    offsets_m = _offsets_m([known[name] for name in names], true)
    return _widest_m([*offsets_m, STILL] if anchored else offsets_m)


def _offsets_m(known: Iterable[State], true: Iterable[State]) -> list[Vector]:
    """Return how far each is from where it is taken to be."""
    offsets_m = []
    for taken, state in zip(known, true, strict=True):
        (e, n, u), (true_e, true_n, true_u) = taken.position_m, state.position_m
        offsets_m.append((e - true_e, n - true_n, u - true_u))
    return offsets_m


def _widest_m(offsets_m: Sequence[Vector]) -> float:
    return max((math.dist(one, other) for one, other in combinations(offsets_m, 2)), default=0.0)
