"""The order of a campaign: shuffled, as far as people can walk it.

Whatever drifts during a day (sun, batteries, other people's Wi-Fi) must not look like an effect of distance, so the
order is random. Rigging robots anew is dearest and carrying them is dear, so it is random within blocks: all trials
of a topology, in it all of a scenario, in it all at a distance; and the way between the places has a bound.
"""

import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby, permutations, product
from typing import Final

from fieldkit.core.model import Distance, Placement, Scenario, Topology


@dataclass(frozen=True)
class PlannedTrial:
    """One trial of a campaign; `str` gives the name by which campaign.yaml and people call it, `los 30ft master`.

    Attributes:
        procedure: Name of its procedure.
        scenario: The procedure's.
        topology: Topology.
        distance: Distance.
    """

    procedure: str
    scenario: Scenario
    topology: Topology
    distance: Distance

    @property
    def placement(self) -> Placement:
        """Places where the robots are to stand."""
        return Placement(self.scenario, self.topology, self.distance)

    def __str__(self) -> str:
        return f"{self.procedure} {self.distance.label} {self.topology}"


Order = tuple[PlannedTrial, ...]

DEFAULT_WALK: Final = 3.0
"""Bound on the way where the file gives none, as a multiple of the shortest."""

_WALKERS: Final = {Topology.MASTER: 2, Topology.MASTERLESS: 1}
_SWAPS_PER_TRIAL: Final = 50
_ROUNDING_M: Final = 1e-6


def walk_m(trials: Iterable[PlannedTrial]) -> float:
    """Return the way of all robots that are carried, from place to place, in metres.

    In `master` both stations walk, from and to the relay; in `masterless` the sender does. Each topology begins at 0.
    """
    total_m = 0.0
    for topology, block in groupby(trials, key=lambda trial: trial.topology):
        at_m = 0.0
        for trial in block:
            total_m += _WALKERS[topology] * abs(trial.distance.metres - at_m)
            at_m = trial.distance.metres
    return total_m


def shortest(trials: Sequence[PlannedTrial]) -> Order:
    """Return an order with the shortest way.

    All places of a scenario lie on a line, so the shortest way through them is a sweep, up or down.
    """
    return tuple(chain.from_iterable(min(_sweeps(block), key=walk_m) for block in _blocks(trials)))


def shuffled(trials: Sequence[PlannedTrial], *, seed: int, limit_m: float) -> Order:
    """Return a random order whose way is at most `limit_m`.

    A random walk over the orders within the limit: swap two blocks or trials at random, and take that back if the way
    grows too long. A swap and its opposite are equally likely, so that no order that can be reached is preferred.

    Args:
        trials: The trials; their own order does not matter.
        seed: Equal seeds give equal orders.
        limit_m: At least the way of `shortest`.
    """
    draw = random.Random(seed)  # noqa: S311 (an order, no secret)
    order = shortest(sorted(trials, key=_path))
    for _ in range(_SWAPS_PER_TRIAL * len(order)):
        other = _swapped(order, draw)
        if walk_m(other) <= limit_m + _ROUNDING_M:
            order = other
    return order


def _path(trial: PlannedTrial) -> tuple[str | float, ...]:
    """Return the blocks that a trial lies in, from the outermost to itself."""
    return trial.topology, trial.scenario, trial.distance.metres, trial.procedure


def _blocks(trials: Sequence[PlannedTrial]) -> Iterator[list[PlannedTrial]]:
    for topology in dict.fromkeys(trial.topology for trial in trials):
        yield [trial for trial in trials if trial.topology is topology]


def _sweeps(block: list[PlannedTrial]) -> Iterator[list[PlannedTrial]]:
    scenarios = dict.fromkeys(trial.scenario for trial in block)
    for order in permutations(scenarios):
        for down in product((False, True), repeat=len(order)):
            yield [
                trial
                for scenario, reverse in zip(order, down, strict=True)
                for trial in sorted(block, key=lambda trial: trial.distance.metres, reverse=reverse)
                if trial.scenario is scenario
            ]


def _swapped(order: Order, draw: random.Random) -> Order:
    """Return the order with two blocks swapped that lie in the same larger one; they may be one and the same."""
    depth = 1 + _below(len(_path(order[0])), draw)
    blocks = [tuple(block) for _, block in groupby(order, key=lambda trial: _path(trial)[:depth])]
    parents = [_path(block[0])[: depth - 1] for block in blocks]
    one = _below(len(blocks), draw)
    siblings = [index for index, parent in enumerate(parents) if parent == parents[one]]
    other = siblings[_below(len(siblings), draw)]
    blocks[one], blocks[other] = blocks[other], blocks[one]
    return tuple(chain.from_iterable(blocks))


def _below(count: int, draw: random.Random) -> int:
    # Of random.Random only `random` gives the same numbers in every version of Python.
    return int(draw.random() * count)
