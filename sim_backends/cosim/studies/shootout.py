"""All policies on one scenario: how wrong each is, and what it costs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim_backends.cosim.comparison import Errors, mean_errors
from sim_backends.cosim.studies.formation import NOBODY, Formation, mean_formation
from sim_backends.cosim.studies.intervals import Floats
from sim_backends.cosim.studies.outcomes import Outcomes
from sim_backends.cosim.studies.tracks import Tracks


@dataclass(frozen=True)
class Row:
    """One policy in the table.

    Attributes:
        policy: Its name.
        by_seed: Its coupled errors with each seed; empty where it could not be run.
        formations: How well followers kept their place with each seed.
        growth_m: How far the agent that is farthest off is from where it is in the reference, mean over seeds, with
            the times in seconds: both of shape (times,).
        failure: Why it could not be run, with one seed at least; empty where it could.
    """

    policy: str
    by_seed: Sequence[Errors]
    formations: Sequence[Formation]
    growth_m: tuple[Floats, Floats]
    failure: str

    @property
    def errors(self) -> Errors | None:
        """The errors of all seeds in one; None where there are none."""
        return mean_errors(self.by_seed) if self.by_seed else None

    @property
    def formation(self) -> Formation | None:
        """The formations of all seeds in one; None where there are none."""
        return mean_formation(self.formations) if self.formations else None


def rows(found: Outcomes, formation: Callable[[Tracks], Formation] = lambda _: NOBODY) -> list[Row]:
    """Return a row for each policy, the exact reference first.

    Args:
        found: What came of all runs.
        formation: Tells of a run how well followers kept their place.
    """
    return [
        Row(
            policy,
            tuple(found.errors(policy, seed) for seed in found.seeds if seed in runs),
            tuple(formation(runs[seed].tracks) for seed in found.seeds if seed in runs),
            _growth_m(found, policy),
            str(found.failures.get(policy, "")),
        )
        for policy, runs in found.runs.items()
    ]


def _growth_m(found: Outcomes, policy: str) -> tuple[Floats, Floats]:
    pairs = [(found.reference[seed].tracks, one.tracks) for seed, one in found.runs[policy].items()]
    apart = [one.apart_m(reference).max(axis=1) for reference, one in pairs]
    length = min(map(len, apart), default=0)
    if not length:
        return np.zeros(0), np.zeros(0)
    return pairs[0][0].times_s[:length], np.mean([one[:length] for one in apart], axis=0)
