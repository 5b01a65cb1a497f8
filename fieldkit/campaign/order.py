"""The order of a campaign: random, within a limit on the walking distance.

Slow changes during a day (sun, batteries, other Wi-Fi networks) must not be mistaken for an effect of distance, so
the order is random. Setting up robots for another topology takes longest, and carrying robots takes long. Therefore
the order is random within nested blocks. A block has all trials of one topology. Within it, a block has all trials of
one scenario; within that, a block has all trials at one distance. The total path is limited.
"""

import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby, permutations, product
from typing import Final

from fieldkit.core.model import Distance, Placement, Scenario, Topology


@dataclass(frozen=True)
class PlannedTrial:
    """One trial of a campaign; `str` gives its name in campaign.yaml and in messages, `los 30ft master`.

    Attributes:
        procedure: Name of its procedure.
        scenario: Scenario of the procedure.
        topology: Topology.
        distance: Distance.
    """

    procedure: str
    scenario: Scenario
    topology: Topology
    distance: Distance

    @property
    def placement(self) -> Placement:
        """The places of the robots."""
        return Placement(self.scenario, self.topology, self.distance)

    def __str__(self) -> str:
        return f"{self.procedure} {self.distance.label} {self.topology}"


Order = tuple[PlannedTrial, ...]

DEFAULT_WALK: Final = 3.0
"""Default limit on the path, as a multiple of the shortest path."""

_CARRIED_ROBOTS: Final = {Topology.MASTER: 2, Topology.MASTERLESS: 1}
_SWAPS_PER_TRIAL: Final = 50
"""Number of random swaps that are tried, per trial."""
_ROUNDING_M: Final = 1e-6


def walk_m(trials: Iterable[PlannedTrial]) -> float:
    """Return the length of the path along which robots are carried, in metres.

    In `master` both stations are carried, starting at the relay; in `masterless` only the sender is carried. The
    path of each topology starts at distance 0.
    """
    total_m = 0.0
    for topology, block in groupby(trials, key=lambda trial: trial.topology):
        position_m = 0.0
        for trial in block:
            total_m += _CARRIED_ROBOTS[topology] * abs(trial.distance.metres - position_m)
            position_m = trial.distance.metres
    return total_m


def shortest(trials: Sequence[PlannedTrial]) -> Order:
    """Return an order with the shortest path.

    All places of a scenario are on a line, so the shortest path through them is a sweep, up or down.
    """
    return tuple(chain.from_iterable(min(_sweeps(block), key=walk_m) for block in _blocks(trials)))


def shuffle(trials: Sequence[PlannedTrial], *, seed: int, limit_m: float) -> Order:
    """Return a random order whose path is at most `limit_m`.

    This is a random walk over the orders within the limit: two blocks or trials are swapped at random, and the swap
    is undone if the path becomes too long. A swap and its inverse are equally likely, so all reachable orders become
    equally likely after many swaps.

    Args:
        trials: The trials in any order.
        seed: Equal seeds give equal orders.
        limit_m: At least the path of `shortest`.
    """
    rng = random.Random(seed)  # noqa: S311 (not for cryptography)
    order = shortest(sorted(trials, key=_block_keys))
    for _ in range(_SWAPS_PER_TRIAL * len(order)):
        candidate = _swap_blocks(order, rng)
        if walk_m(candidate) <= limit_m + _ROUNDING_M:
            order = candidate
    return order


def _block_keys(trial: PlannedTrial) -> tuple[str | float, ...]:
    """Return the keys of the blocks that contain a trial, from the outermost to the trial itself."""
    return trial.topology, trial.scenario, trial.distance.metres, trial.procedure


def _blocks(trials: Sequence[PlannedTrial]) -> Iterator[list[PlannedTrial]]:
    for topology in dict.fromkeys(trial.topology for trial in trials):
        yield [trial for trial in trials if trial.topology is topology]


def _sweeps(block: list[PlannedTrial]) -> Iterator[list[PlannedTrial]]:
    """Yield the orders of a topology in which each scenario has ascending or descending distances."""
    scenarios = dict.fromkeys(trial.scenario for trial in block)
    for order in permutations(scenarios):
        for directions in product((False, True), repeat=len(order)):
            yield [
                trial
                for scenario, reverse in zip(order, directions, strict=True)
                for trial in sorted(block, key=lambda trial: trial.distance.metres, reverse=reverse)
                if trial.scenario is scenario
            ]


def _swap_blocks(order: Order, rng: random.Random) -> Order:
    """Return the order after a swap of two random blocks of the same larger block.

    The two may be the same block; the order is then unchanged.
    """
    depth = 1 + _random_index(len(_block_keys(order[0])), rng)
    blocks = [tuple(block) for _, block in groupby(order, key=lambda trial: _block_keys(trial)[:depth])]
    parents = [_block_keys(block[0])[: depth - 1] for block in blocks]
    first = _random_index(len(blocks), rng)
    siblings = [index for index, parent in enumerate(parents) if parent == parents[first]]
    second = siblings[_random_index(len(siblings), rng)]
    blocks[first], blocks[second] = blocks[second], blocks[first]
    return tuple(chain.from_iterable(blocks))


def _random_index(count: int, rng: random.Random) -> int:
    # Only `random` of random.Random returns the same numbers in every version of Python.
    return int(rng.random() * count)
