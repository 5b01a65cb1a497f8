"""Runs of one scenario with several policies and seeds, and their outcomes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.comparison import Errors, errors
from sim_backends.cosim.policies.base import PolicyError
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.run import Run
from sim_backends.cosim.studies.seeds import Task, run_many
from sim_backends.cosim.studies.tracks import SampledPhysics, Tracks

SAMPLING_NS = 100_000_000
"""Interval at which the positions of agents are sampled."""


class Simulated(Protocol):
    """A scenario that is ready to run, as `scenario.build.Simulation`."""

    agents: Agents

    def run(self) -> Run:
        """Simulate until the scenario's end."""
        ...


Make = Callable[[str, int], Simulated]
"""Builds the scenario for the name of a policy and a seed."""


@dataclass(frozen=True)
class RunOutcome:
    """The outcome of a run.

    Attributes:
        run: The record.
        tracks: The sampled positions of agents.
    """

    run: Run
    tracks: Tracks


@dataclass(frozen=True)
class Outcomes:
    """The outcomes of all runs of a scenario.

    Attributes:
        seeds: The seeds.
        reference: Outcomes with the exact reference, by seed.
        runs: Outcomes by policy, including the reference, and by seed; runs that failed are missing.
        failures: The error of each policy that failed, with the first seed for which it did.
    """

    seeds: Sequence[int]
    reference: Mapping[int, RunOutcome]
    runs: Mapping[str, Mapping[int, RunOutcome]]
    failures: Mapping[str, PolicyError]

    def errors(self, policy: str, seed: int) -> Errors:
        """Return the errors of one run relative to the reference with the same seed."""
        reference, outcome = self.reference[seed], self.runs[policy][seed]
        return errors(reference.run, outcome.run, outcome.tracks.distances_m(reference.tracks))


def outcomes(
    make: Make,
    policies: Sequence[str],
    seeds: Sequence[int],
    *,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Outcomes:
    """Run a scenario with each policy and each seed, including the exact reference.

    Args:
        make: Builds the scenario; it must be picklable.
        policies: Names of policies.
        seeds: The seeds.
        workers: As for `run_many`.
        progress: As for `run_many`.

    Raises:
        FieldkitError: A run failed for another reason than that its policy had no window.
    """
    names = [EventDriven.name, *(name for name in policies if name != EventDriven.name)]
    tasks = [Task(name, seed) for name in names for seed in seeds]
    results = run_many(partial(_outcome, make), tasks, workers=workers, progress=progress)
    runs: dict[str, dict[int, RunOutcome]] = {name: {} for name in names}
    failures: dict[str, PolicyError] = {}
    for task, result in zip(tasks, results, strict=True):
        if isinstance(result, PolicyError):
            failures.setdefault(task.policy, result)
        else:
            runs[task.policy][task.seed] = result
    return Outcomes(tuple(seeds), runs[EventDriven.name], runs, failures)


def _outcome(make: Make, task: Task) -> RunOutcome | PolicyError:
    simulated = make(task.policy, task.seed)
    sampled = SampledPhysics(simulated.agents.physics, SAMPLING_NS)
    simulated.agents.physics = sampled
    try:
        return RunOutcome(simulated.run(), sampled.tracks)
    except PolicyError as error:
        return error
