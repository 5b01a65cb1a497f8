"""All policies on one scenario: how wrong each is, and what it costs."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_backends.cosim.comparison import Errors, mean_errors
from sim_backends.cosim.studies.outcomes import Outcomes


@dataclass(frozen=True)
class Row:
    """One policy in the table.

    Attributes:
        policy: Its name.
        by_seed: Its coupled errors with each seed; empty where it could not be run.
        failure: Why it could not be run, with one seed at least; empty where it could.
    """

    policy: str
    by_seed: Sequence[Errors]
    failure: str

    @property
    def errors(self) -> Errors | None:
        """The errors of all seeds in one; None where there are none."""
        return mean_errors(self.by_seed) if self.by_seed else None


def rows(found: Outcomes) -> list[Row]:
    """Return a row for each policy, the exact reference first."""
    return [
        Row(
            policy,
            tuple(found.errors(policy, seed) for seed in found.seeds if seed in runs),
            str(found.failures.get(policy, "")),
        )
        for policy, runs in found.runs.items()
    ]
