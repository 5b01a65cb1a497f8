"""Runs of a scenario, one per seed, and how far they are."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from fieldkit.core.errors import FieldkitError
from fieldkit.core.events import Progress, Sink
from fieldkit.core.model import Vector
from sim_backends.cosim.commands.flows import FlowResult, flow_results
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.build import build
from sim_backends.cosim.scenario.schema import CosimScenario


@dataclass(frozen=True)
class Outcome:
    """What came of a run.

    Attributes:
        seed: Its seed.
        flows: What became of its flows.
        simulated_s: Simulated time.
        windows: How many windows it had.
        wall_s: Wall time by part.
        digest: Hash over all that happened.
        starts_m: Where each agent stood at time 0, metres east, north, up.
        stopped: Why it did not come to its end; empty where it did.
    """

    seed: int
    flows: Sequence[FlowResult]
    simulated_s: float
    windows: int
    wall_s: Mapping[str, float]
    digest: str
    starts_m: Mapping[str, Vector]
    stopped: str = ""


def outcomes(scenario: CosimScenario, policy: str | None, seeds: Sequence[int], sink: Sink) -> Iterator[Outcome]:
    """Yield what comes of a scenario with each seed.

    Args:
        scenario: The scenario.
        policy: Name of a sync policy; None for the scenario's.
        seeds: Seeds, in order.
        sink: Is told how far they are.

    Raises:
        FieldkitError: A run could not go on: what came of it until then was yielded.
        KeyboardInterrupt: The same holds.
    """
    clock = _Clock(sink, len(seeds), scenario.duration)
    for before, seed in enumerate(seeds):
        simulation = build(scenario, policy=policy, seed=seed)
        starts_m = {name: state.position_m for name, state in simulation.agents.states(0).items()}
        what = f"seed {seed}" if len(seeds) == 1 else f"seed {seed}, {before + 1} of {len(seeds)}"
        ended_by: FieldkitError | KeyboardInterrupt | None = None
        try:
            simulation.run(progress=clock.teller(what, before))
        except (FieldkitError, KeyboardInterrupt) as error:
            ended_by = error
        yield _outcome(seed, simulation.coordinator.run, starts_m, ended_by)
        if ended_by is not None:
            raise ended_by


def _outcome(
    seed: int, run: Run, starts_m: Mapping[str, Vector], ended_by: FieldkitError | KeyboardInterrupt | None
) -> Outcome:
    ended_s = run.windows_ns[-1] / 1e9 if run.windows_ns else 0.0
    stopped = ended_by.located if isinstance(ended_by, FieldkitError) else f"interrupted at {ended_s:g} s"
    return Outcome(
        seed=seed,
        flows=flow_results(run),
        simulated_s=ended_s,
        windows=len(run.windows_ns),
        wall_s=dict(run.wall_s),
        digest=run.digest,
        starts_m=starts_m,
        stopped=stopped if ended_by is not None else "",
    )


class _Clock:
    """Tells how far runs are, by simulated time.

    Args:
        sink: Who is told.
        runs: How many there are.
        duration_s: Simulated time of each.
    """

    def __init__(self, sink: Sink, runs: int, duration_s: float) -> None:
        self._sink = sink
        self._runs = runs
        self._duration_s = duration_s
        self._begun_s = time.monotonic()

    def teller(self, what: str, before: int) -> Callable[..., None]:
        """Return what a simulation, with so many before it, calls with its time now and then."""

        def tell(now_ns: int, *_: object) -> None:
            now_s = now_ns / 1e9
            share = (before + now_s / self._duration_s) / self._runs
            left_s = (time.monotonic() - self._begun_s) * (1 / share - 1) if share else None
            self._sink(Progress(what, round(now_s, 1), self._duration_s, "s", left_s))

        return tell
