"""Runs of one scenario by several policies and seeds, and what came of each."""

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
from sim_backends.cosim.studies.tracks import Tracked, Tracks

LOOK_NS = 100_000_000
"""How often agents are looked at."""


class Simulated(Protocol):
    """A scenario that is ready to run, as `scenario.build.Simulation`."""

    agents: Agents

    def run(self) -> Run:
        """Go on until the scenario's end."""
        ...


Make = Callable[[str, int], Simulated]
"""Builds one for the name of a policy and a seed."""


@dataclass(frozen=True)
class RunOutcome:
    """What came of a run.

    Attributes:
        run: What was recorded.
        tracks: Where agents were.
    """

    run: Run
    tracks: Tracks


@dataclass(frozen=True)
class Outcomes:
    """What came of all runs of a scenario.

    Attributes:
        seeds: The seeds.
        reference: Of the exact reference, by seed.
        runs: By policy, the reference among them, and seed; without those that could not be run.
        failures: Why a policy could not be run, with the first seed that it failed with.
    """

    seeds: Sequence[int]
    reference: Mapping[int, RunOutcome]
    runs: Mapping[str, Mapping[int, RunOutcome]]
    failures: Mapping[str, PolicyError]

    def errors(self, policy: str, seed: int) -> Errors:
        """Return the coupled errors of one run."""
        reference, one = self.reference[seed], self.runs[policy][seed]
        return errors(reference.run, one.run, one.tracks.apart_m(reference.tracks))


def outcomes(
    make: Make,
    policies: Sequence[str],
    seeds: Sequence[int],
    *,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Outcomes:
    """Run a scenario by each policy with each seed, by the exact reference too.

    Args:
        make: Builds the scenario; can be pickled.
        policies: Names of policies.
        seeds: The seeds.
        workers: As of `run_many`.
        progress: As of `run_many`.

    Raises:
        FieldkitError: A run failed otherwise than by its policy having no window.
    """
    names = [EventDriven.name, *(name for name in policies if name != EventDriven.name)]
    tasks = [Task(name, seed) for name in names for seed in seeds]
    found = run_many(partial(_outcome, make), tasks, workers=workers, progress=progress)
    runs: dict[str, dict[int, RunOutcome]] = {name: {} for name in names}
    failures: dict[str, PolicyError] = {}
    for task, outcome in zip(tasks, found, strict=True):
        if isinstance(outcome, PolicyError):
            failures.setdefault(task.policy, outcome)
        else:
            runs[task.policy][task.seed] = outcome
    return Outcomes(tuple(seeds), runs[EventDriven.name], runs, failures)


def _outcome(make: Make, task: Task) -> RunOutcome | PolicyError:
    simulated = make(task.policy, task.seed)
    tracked = Tracked(simulated.agents.physics, LOOK_NS)
    simulated.agents.physics = tracked
    try:
        return RunOutcome(simulated.run(), tracked.tracks)
    except PolicyError as error:
        return error
