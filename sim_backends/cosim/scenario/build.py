"""What a scenario is run with: agents, network and coordinator."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator, Run
from sim_backends.cosim.federates import NetworkFederate, Program
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.programs.several import Several
from sim_backends.cosim.scenario.motions import WayPointsPlan
from sim_backends.cosim.scenario.policies import make_policy
from sim_backends.cosim.scenario.schema import AgentPlan, CosimScenario
from sim_backends.network.disc import Disc
from sim_backends.physics.paths import Paths
from sim_backends.radio.random_streams import Stream
from sim_backends.world.motion import Motion, WayPoints
from sim_backends.world.world import World, load_world

_ANTENNA_M = 0.2


@dataclass
class Simulation:
    """A scenario that is ready to run, once.

    Attributes:
        scenario: What it was built from.
        seed: Of its random draws.
        agents: Bodies and programs.
        network: Carries packets.
        coordinator: Runs both.
    """

    scenario: CosimScenario
    seed: int
    agents: Agents
    network: NetworkFederate
    coordinator: Coordinator

    def run(self, until_ns: int | None = None, progress: Callable[[int], None] | None = None) -> Run:  # noqa: ARG002
        """Go on until a time, or to the scenario's end; return what was recorded so far.

        Args:
            until_ns: Until when, in nanoseconds of simulated time.
            progress: Called with the time reached, now and then.

        Raises:
            PolicyError: The policy has no window; what was recorded is in `coordinator.run`.
        """
        return self.coordinator.advance(self.scenario.duration_ns if until_ns is None else until_ns)


def build(
    scenario: CosimScenario,
    *,
    policy: str | SyncPolicy | None = None,
    seed: int | None = None,
    recorder: Any = None,  # noqa: ANN401, ARG001
) -> Simulation:
    """Return a scenario as a simulation.

    Args:
        scenario: The scenario.
        policy: Its sync policy, or the name of one; None for the scenario's.
        seed: Of all random draws; None for the scenario's first.
        recorder: Is told of every window.

    Raises:
        ConfigurationError: It cannot be run; says why.
    """
    seed = scenario.seeds[0] if seed is None else seed
    if policy is None or isinstance(policy, str):
        policy = make_policy(policy or scenario.policy.name, **scenario.policy.parameters)
    world = load_world(scenario.world)
    agents = Agents(_physics(scenario, world), _programs(scenario, seed))
    network = Disc(100.0, 1_000_000)
    pairs = sorted({(one.source, to) for one in scenario.traffic for to in one.to})
    return Simulation(scenario, seed, agents, network, Coordinator(agents, network, policy, pairs))


def _programs(scenario: CosimScenario, seed: int) -> dict[str, Program]:
    programs: dict[str, list[Program]] = {}
    for one in scenario.traffic:
        period_ns = round(1e9 / one.rate)
        for flow, receiver in one.flows.items():
            first_ns = (
                round(one.start * 1e9)
                if one.start is not None
                else int(Stream(seed, flow, "phase").draw(0) * period_ns)
            )
            programs.setdefault(one.source, []).append(
                Periodic(
                    flow,
                    receiver,
                    period_ns=period_ns,
                    size_bytes=one.size_bytes,
                    protocol=one.protocol,
                    first_ns=first_ns,
                    stop_ns=None if one.stop is None else round(one.stop * 1e9),
                )
            )
    return {name: Several(several) for name, several in programs.items()}


def _physics(scenario: CosimScenario, world: World) -> Paths:
    motions = [_motion(name, agent, _start_m(agent, scenario, world)) for name, agent in scenario.agents.items()]
    return Paths(motions, step_ns=scenario.physics.step_ns)


def _motion(name: str, agent: AgentPlan, start_m: Vector) -> Motion:
    plan = agent.motion
    if not isinstance(plan, WayPointsPlan):
        return WayPoints(name, [start_m], 1.0)
    from_m = start_m if plan.relative else (0.0, 0.0, 0.0)
    points_m: list[Vector] = [start_m]
    for east_m, north_m, *up_m in plan.points_m:
        points_m.append((from_m[0] + east_m, from_m[1] + north_m, (from_m[2] + up_m[0]) if up_m else points_m[-1][2]))
    return WayPoints(name, points_m, plan.speed)


def _start_m(agent: AgentPlan, scenario: CosimScenario, world: World) -> Vector:
    if agent.at_m is not None:
        place = agent.at_m
    else:
        line = world.lines.get(scenario.line)
        if line is None or agent.along is None:
            raise ConfigurationError(
                f"the world {world.name} has no line {scenario.line}", remedy="give agents at_m: [EAST, NORTH]"
            )
        place = line.at(agent.along, agent.aside_m)
    return *place, world.ground_m(place) + (_ANTENNA_M if agent.height is None else agent.height)
