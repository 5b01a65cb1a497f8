"""Runs of a scenario, one per seed, and how far they are."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial

from fieldkit.config import schema
from fieldkit.core.errors import FieldkitError
from fieldkit.core.events import Sink
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.folder import RunFolder
from sim_backends.cosim.commands.results import SeedResult, seed_result
from sim_backends.cosim.recording.manifest import About
from sim_backends.cosim.recording.recorder import RunRecorder
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.seeds import Task, run_many


def simulate(
    scenario: CosimScenario,
    policy: str,
    seed: int,
    folder: RunFolder | None,
    told: Callable[[int, float], None] | None = None,
) -> SeedResult:
    """Return what came of a scenario with a seed, also where the run could not go on, or was interrupted.

    Args:
        scenario: The scenario.
        policy: Name of the sync policy.
        seed: The seed.
        folder: Where it is kept; None to keep nothing.
        told: As of `Simulation.run`.
    """
    recorder = None if folder is None else RunRecorder(folder.of(seed), _about(scenario, policy, seed))
    simulation = build(scenario, policy=policy, seed=seed, recorder=recorder)
    starts_m = {name: state.position_m for name, state in simulation.agents.states(0).items()}
    ended_by: FieldkitError | KeyboardInterrupt | None = None
    try:
        with recorder or nullcontext():
            simulation.run(progress=told)
    except (FieldkitError, KeyboardInterrupt) as error:
        ended_by = error
    result = seed_result(seed, simulation.coordinator.run, starts_m, ended_by)
    if folder is not None:
        folder.keep(result)
    return result


def simulate_all(
    scenario: CosimScenario, policy: str, seeds: Sequence[int], folder: RunFolder | None, sink: Sink
) -> list[SeedResult]:
    """Return what came of a scenario with each seed, run side by side.

    Args:
        scenario: The scenario.
        policy: Name of the sync policy.
        seeds: The seeds.
        folder: Where all are kept; None to keep nothing.
        sink: Is told how far they are.
    """
    if len(seeds) == 1:
        told = partial(teller(sink, "s"), "simulate", scenario.duration)
        told(0)
        return [simulate(scenario, policy, seeds[0], folder, lambda now_ns, _: told(round(now_ns / 1e9, 1)))]
    told = partial(teller(sink), "simulate", len(seeds))
    told(0)
    return run_many(partial(_simulate, scenario, folder), [Task(policy, seed) for seed in seeds], progress=told)


def _simulate(scenario: CosimScenario, folder: RunFolder | None, task: Task) -> SeedResult:
    return simulate(scenario, task.policy, task.seed, folder)


def _about(scenario: CosimScenario, policy: str, seed: int) -> About:
    return About(schema.dump(scenario), policy, scenario.policy.parameters, seed)
