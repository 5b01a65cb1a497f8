"""Runs of a scenario, one per seed, and how far they are."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial

from fieldkit.config import schema
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.events import Sink
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.folder import RunFolder
from sim_backends.cosim.commands.results import SeedResult, seed_result
from sim_backends.cosim.interrupts import between_windows
from sim_backends.cosim.recording.manifest import About
from sim_backends.cosim.recording.recorder import RunRecorder
from sim_backends.cosim.recording.samples import StateSamples
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.stalls import DEADLINE_S
from sim_backends.cosim.studies.formation import has_followers
from sim_backends.cosim.studies.seeds import Task, as_they_end


def simulate(
    scenario: CosimScenario,
    policy: str,
    seed: int,
    folder: RunFolder | None,
    *,
    told: Callable[[int, float], None] | None = None,
    deadline_s: float | None = DEADLINE_S,
) -> SeedResult:
    """Return what came of a scenario with a seed, also where the run could not go on, or was interrupted.

    Args:
        scenario: The scenario.
        policy: Name of the sync policy.
        seed: The seed.
        folder: Where it is kept; None to keep nothing.
        told: As of `Simulation.run`.
        deadline_s: As of `build`.
    """
    recorder = None if folder is None else RunRecorder(folder.of(seed), _about(scenario, policy, seed))
    samples = StateSamples(recorder) if has_followers(scenario) else None
    simulation = build(scenario, policy=policy, seed=seed, recorder=samples or recorder, deadline_s=deadline_s)
    begin = [(0, name, state) for name, state in simulation.agents.states(0).items()]
    ended_by: FieldkitError | KeyboardInterrupt | None = None
    try:
        with recorder or nullcontext(), between_windows(simulation.coordinator):
            simulation.run(progress=told)
    except (FieldkitError, KeyboardInterrupt) as error:
        ended_by = error
    states = begin if samples is None else samples.states
    result = seed_result(scenario, seed, simulation.coordinator.run, states, ended_by)
    if folder is not None:
        try:
            folder.keep(result)
        except ConfigurationError:
            if ended_by is None:  # else what ended the run, which may be the same disk, is told
                raise
    return result


def simulate_all(
    scenario: CosimScenario,
    policy: str,
    seeds: Sequence[int],
    folder: RunFolder | None,
    *,
    sink: Sink,
    deadline_s: float | None = DEADLINE_S,
) -> tuple[list[SeedResult], bool]:
    """Return what came of a scenario with each seed, run side by side, and whether Ctrl-C ended that.

    Of several seeds those are left out that had not ended then.

    Args:
        scenario: The scenario.
        policy: Name of the sync policy.
        seeds: The seeds.
        folder: Where all are kept; None to keep nothing.
        sink: Is told how far they are.
        deadline_s: As of `build`.
    """
    if len(seeds) == 1:
        told = partial(teller(sink, "s"), "simulate", scenario.duration)
        told(0)
        result = simulate(
            scenario,
            policy,
            seeds[0],
            folder,
            told=lambda now_ns, _: told(round(now_ns / 1e9, 1)),
            deadline_s=deadline_s,
        )
        return [result], result.is_interrupted
    told = partial(teller(sink), "simulate", len(seeds))
    told(0)
    results: dict[int, SeedResult] = {}
    tasks = [Task(policy, seed) for seed in seeds]
    interrupted = False
    try:
        for number, result in as_they_end(partial(_simulate, scenario, folder, deadline_s), tasks):
            results[number] = result
            told(len(results))
            if result.is_interrupted:  # which it is itself where there is one processor
                interrupted = True
                break
    except KeyboardInterrupt:
        interrupted = True
    return [results[number] for number in sorted(results)], interrupted


def _simulate(scenario: CosimScenario, folder: RunFolder | None, deadline_s: float | None, task: Task) -> SeedResult:
    return simulate(scenario, task.policy, task.seed, folder, deadline_s=deadline_s)


def _about(scenario: CosimScenario, policy: str, seed: int) -> About:
    return About(schema.dump(scenario), policy, scenario.policy.parameters, seed)
