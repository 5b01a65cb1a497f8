"""The result of a run, as the numbers of tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Vector
from sim_backends.cosim.commands.flows import FlowResult, flow_results
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.recovery import FlowRecovery, recoveries
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.studies.formation import Formation, formation
from sim_backends.cosim.studies.tracks import tracks_of
from sim_backends.world.motion import State


@dataclass(frozen=True)
class SeedResult:
    """The result of a run.

    Attributes:
        seed: Its seed.
        flows: The results of its flows.
        simulated_s: Simulated time.
        windows: Number of windows.
        wall_s: Wall time by part.
        digest: Hash over all events.
        starts_m: Position of each agent at time 0, metres east, north, up.
        recoveries: Recoveries of flows after faults.
        formation: How well followers kept their positions.
        stopped: Why it ended early; empty if it is complete.
        error: The error that ended it early; None if it is complete or was interrupted.
    """

    seed: int
    flows: Sequence[FlowResult]
    simulated_s: float
    windows: int
    wall_s: Mapping[str, float]
    digest: str
    starts_m: Mapping[str, Vector]
    recoveries: Sequence[FlowRecovery]
    formation: Formation
    stopped: str = ""
    error: FieldkitError | None = None

    @property
    def is_interrupted(self) -> bool:
        """True if Ctrl-C ended it."""
        return bool(self.stopped) and self.error is None


def seed_result(
    scenario: CosimScenario,
    seed: int,
    run: Run,
    states: Sequence[tuple[int, str, State]],
    ended_by: FieldkitError | KeyboardInterrupt | None = None,
) -> SeedResult:
    """Return the result of a run.

    Args:
        scenario: The scenario.
        seed: Its seed.
        run: The record.
        states: States of agents, as `Recording.states`, at least for time 0.
        ended_by: The exception that ended it early, or None.
    """
    ended_s = run.windows_ns[-1] / 1e9 if run.windows_ns else 0.0
    error = ended_by if isinstance(ended_by, FieldkitError) else None
    stopped = error.located if error is not None else f"interrupted at {ended_s:g} s"
    return SeedResult(
        seed=seed,
        flows=flow_results(run),
        simulated_s=ended_s,
        windows=len(run.windows_ns),
        wall_s=dict(run.wall_s),
        digest=run.digest,
        starts_m={agent: state.position_m for at_ns, agent, state in states if at_ns == 0},
        recoveries=recoveries(scenario, run),
        formation=formation(scenario, tracks_of(states)),
        stopped="" if ended_by is None else stopped,
        error=error,
    )
