"""All policies on one scenario: the error and the cost of each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim_backends.cosim.comparison import Errors, mean_errors
from sim_backends.cosim.studies.formation import NO_FORMATION, Formation, mean_formation
from sim_backends.cosim.studies.intervals import Floats
from sim_backends.cosim.studies.outcomes import Outcomes
from sim_backends.cosim.studies.tracks import Tracks


@dataclass(frozen=True)
class Row:
    """The results of one policy.

    Attributes:
        policy: Its name.
        by_seed: Its errors relative to the reference for each seed; empty if it could not be run.
        formations: How well followers kept their positions, for each seed.
        growth_m: Times in seconds, and the largest distance of an agent from its position in the reference, mean over
            seeds: both of shape (times,).
        failure: Why it could not be run with at least one seed; empty if it could.
    """

    policy: str
    by_seed: Sequence[Errors]
    formations: Sequence[Formation]
    growth_m: tuple[Floats, Floats]
    failure: str

    @property
    def errors(self) -> Errors | None:
        """The errors of all seeds as one; None if there are none."""
        return mean_errors(self.by_seed) if self.by_seed else None

    @property
    def formation(self) -> Formation | None:
        """The formations of all seeds as one; None if there are none."""
        return mean_formation(self.formations) if self.formations else None


def rows(outcomes: Outcomes, formation: Callable[[Tracks], Formation] = lambda _: NO_FORMATION) -> list[Row]:
    """Return a row for each policy, the exact reference first.

    Args:
        outcomes: The outcomes of all runs.
        formation: Returns how well followers kept their positions in a run.
    """
    return [
        Row(
            policy,
            tuple(outcomes.errors(policy, seed) for seed in outcomes.seeds if seed in runs),
            tuple(formation(runs[seed].tracks) for seed in outcomes.seeds if seed in runs),
            _growth_m(outcomes, policy),
            str(outcomes.failures.get(policy, "")),
        )
        for policy, runs in outcomes.runs.items()
    ]


def _growth_m(outcomes: Outcomes, policy: str) -> tuple[Floats, Floats]:
    pairs = [(outcomes.reference[seed].tracks, outcome.tracks) for seed, outcome in outcomes.runs[policy].items()]
    largest_m = [tracks.distances_m(reference).max(axis=1) for reference, tracks in pairs]
    length = min(map(len, largest_m), default=0)
    if not length:
        return np.zeros(0), np.zeros(0)
    return pairs[0][0].times_s[:length], np.mean([of_seed[:length] for of_seed in largest_m], axis=0)
