"""Compares sync policies with the exact reference over seeds: cost, errors, and bias (mean of the differences)."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

import numpy as np

from fieldkit.core.executors import Workers
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.comparison import Errors, compare_runs, lost_share, mean_errors
from sim_backends.cosim.policies.sync_policy import PolicyError
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.run_record import Run
from sim_backends.cosim.studies.formation import NO_FORMATION, Formation, SampledPhysics, Tracks, mean_formation
from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, mean, repeats_needed
from sim_backends.cosim.studies.seeds import ALL_PROCESSORS, Task, run_many

SAMPLING_NS = 100_000_000
"""Interval at which the positions of agents are sampled."""


class RunnableScenario(Protocol):
    """A scenario that is ready to run, like `scenario.build.Simulation`."""

    agents: Agents

    def run(self) -> Run:
        """Simulate until the scenario's end."""
        ...

    def close(self) -> None:
        """Stop the external federates."""
        ...


ScenarioFactory = Callable[[str, int], RunnableScenario]
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
        failures: The error of each policy that failed, from the first seed with which it failed.
    """

    seeds: Sequence[int]
    reference: Mapping[int, RunOutcome]
    runs: Mapping[str, Mapping[int, RunOutcome]]
    failures: Mapping[str, PolicyError]

    def errors(self, policy: str, seed: int) -> Errors:
        """Return the errors of one run relative to the reference with the same seed."""
        reference, outcome = self.reference[seed], self.runs[policy][seed]
        return compare_runs(reference.run, outcome.run, outcome.tracks.distances_m(reference.tracks))


def run_outcomes(
    make_scenario: ScenarioFactory,
    policies: Sequence[str],
    seeds: Sequence[int],
    *,
    workers: Workers = ALL_PROCESSORS,
    progress: Callable[[int], None] | None = None,
) -> Outcomes:
    """Run a scenario with each policy and each seed, including the exact reference.

    Args:
        make_scenario: Builds the scenario; it must be picklable.
        policies: Names of policies.
        seeds: The seeds.
        workers: The workers that run the simulations.
        progress: Called with the number of finished runs, or None.

    Raises:
        FieldkitError: A run failed with an error other than `PolicyError`.
    """
    names = [EventDriven.name, *(name for name in policies if name != EventDriven.name)]
    tasks = [Task(name, seed) for name in names for seed in seeds]
    results = run_many(partial(_outcome, make_scenario), tasks, workers=workers, progress=progress)
    runs: dict[str, dict[int, RunOutcome]] = {name: {} for name in names}
    failures: dict[str, PolicyError] = {}
    for task, result in zip(tasks, results, strict=True):
        if isinstance(result, PolicyError):
            failures.setdefault(task.policy, result)
        else:
            runs[task.policy][task.seed] = result
    return Outcomes(tuple(seeds), runs[EventDriven.name], runs, failures)


def _outcome(make_scenario: ScenarioFactory, task: Task) -> RunOutcome | PolicyError:
    """Return the outcome of a run, or the error with which its policy failed."""
    scenario_run = make_scenario(task.policy, task.seed)
    sampled_physics = SampledPhysics(scenario_run.agents.physics, SAMPLING_NS)
    scenario_run.agents.physics = sampled_physics
    try:
        with closing(scenario_run):
            return RunOutcome(scenario_run.run(), sampled_physics.tracks)
    except PolicyError as error:
        return error


def mean_delay_s(outcome: RunOutcome) -> float:
    """Return the mean time, over packets, from sending to the arrival that counts; nan if no packet arrived."""
    delays_ns = [
        fate.counted_ns - fate.packet.sent_ns for fate in outcome.run.fates.values() if fate.counted_ns is not None
    ]
    return sum(delays_ns) / len(delays_ns) / 1e9 if delays_ns else math.nan


def mean_separation_m(outcome: RunOutcome) -> float:
    """Return the mean distance between agents over time and all pairs; nan for a single agent."""
    positions_m = outcome.tracks.positions_m
    first, second = np.triu_indices(positions_m.shape[1], k=1)
    if not len(first):
        return math.nan
    return float(np.nanmean(np.linalg.norm(positions_m[:, first] - positions_m[:, second], axis=2)))


MEASURES: Final[Mapping[str, Callable[[RunOutcome], float]]] = {
    "loss": lambda outcome: lost_share(outcome.run),
    "delay_s": mean_delay_s,
    "apart_m": mean_separation_m,
}
"""The compared measures, by name."""


@dataclass(frozen=True)
class Bias:
    """The bias of one measure with one policy, over seeds.

    Attributes:
        values: The measure for each seed, in order; nan if a run has none.
        mean: Their mean.
        bias: Mean of the differences from the reference with the same seed.
        deviation: Standard deviation of these differences; nan if there are fewer than two.
        seeds_needed: Number of seeds needed to detect the bias; None if the bias is 0 or unknown.
    """

    values: Floats
    mean: IntervalEstimate
    bias: IntervalEstimate
    deviation: float
    seeds_needed: int | None


def compute_biases(outcomes: Outcomes) -> dict[str, dict[str, Bias]]:
    """Return the bias of each measure for each policy that could be run with all seeds."""
    complete_policies = [name for name, runs in outcomes.runs.items() if len(runs) == len(outcomes.seeds)]
    return {
        policy: {name: _bias(outcomes, policy, measure) for name, measure in MEASURES.items()}
        for policy in complete_policies
    }


def _bias(outcomes: Outcomes, policy: str, measure: Callable[[RunOutcome], float]) -> Bias:
    values = np.array([measure(outcomes.runs[policy][seed]) for seed in outcomes.seeds])
    differences = values - np.array([measure(outcomes.reference[seed]) for seed in outcomes.seeds])
    finite_differences = differences[np.isfinite(differences)]
    bias = mean(finite_differences)
    deviation = float(finite_differences.std(ddof=1)) if len(finite_differences) > 1 else math.nan
    seeds_needed = None if math.isnan(deviation) else repeats_needed(bias.value, deviation)
    return Bias(values, mean(values[np.isfinite(values)]), bias, deviation, seeds_needed)


@dataclass(frozen=True)
class Row:
    """The results of one policy.

    Attributes:
        policy: Name of the policy.
        by_seed: Its errors relative to the reference, for each seed with which it could be run.
        formations: Position errors of the followers, for each seed with which it could be run.
        growth: Two arrays of shape (times,): times in seconds, and the largest distance in metres of an agent from
            its position in the reference at that time, as a mean over these seeds; empty if there are none.
        failure: The reason why the policy could not be run with a seed; empty if it could be run with all seeds.
    """

    policy: str
    by_seed: Sequence[Errors]
    formations: Sequence[Formation]
    growth: tuple[Floats, Floats]
    failure: str

    @property
    def errors(self) -> Errors | None:
        """The combined errors of all seeds; None if there are none."""
        return mean_errors(self.by_seed) if self.by_seed else None

    @property
    def formation(self) -> Formation | None:
        """The combined formations of all seeds; None if there are none."""
        return mean_formation(self.formations) if self.formations else None


def rows(outcomes: Outcomes, formation: Callable[[Tracks], Formation] = lambda _: NO_FORMATION) -> list[Row]:
    """Return a row for each policy, the exact reference first.

    Args:
        outcomes: The outcomes of all runs.
        formation: Returns the position errors of the followers in a run.
    """
    return [
        Row(
            policy,
            tuple(outcomes.errors(policy, seed) for seed in outcomes.seeds if seed in runs),
            tuple(formation(runs[seed].tracks) for seed in outcomes.seeds if seed in runs),
            _growth(outcomes, policy),
            str(outcomes.failures.get(policy, "")),
        )
        for policy, runs in outcomes.runs.items()
    ]


def _growth(outcomes: Outcomes, policy: str) -> tuple[Floats, Floats]:
    """Return the value of `Row.growth` for a policy."""
    pairs = [(outcomes.reference[seed].tracks, outcome.tracks) for seed, outcome in outcomes.runs[policy].items()]
    largest_m = [np.fmax.reduce(tracks.distances_m(reference), axis=1) for reference, tracks in pairs]
    length = min(map(len, largest_m), default=0)
    if not length:
        return np.zeros(0), np.zeros(0)
    return pairs[0][0].times_s[:length], np.mean([distances_m[:length] for distances_m in largest_m], axis=0)
