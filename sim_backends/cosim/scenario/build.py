"""Builds a scenario: agents, network and coordinator."""

from contextlib import ExitStack
from dataclasses import dataclass, field

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator, Progress
from sim_backends.cosim.federates import NetworkFederate, PhysicsFederate
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.run_record import Run, WindowObserver
from sim_backends.cosim.scenario.agent_setup import bodies, controllers, programs, stops
from sim_backends.cosim.scenario.checks import check
from sim_backends.cosim.scenario.external import open_network, open_physics
from sim_backends.cosim.scenario.faults import StalledFederateFault
from sim_backends.cosim.scenario.networks import radio_network
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.wall_time import DEADLINE_S, Stall, stalled
from sim_backends.physics.bodies import Bodies
from sim_backends.world.world import load_world


@dataclass
class Simulation:
    """A scenario that is ready to run, once; a context manager that ends its external federates.

    Attributes:
        scenario: The scenario.
        seed: Seed of all random draws.
        policy: Its sync policy.
        agents: Bodies and programs.
        network: Carries packets.
        coordinator: Runs both.
        federates: Ends the external federates when it is closed.
    """

    scenario: CosimScenario
    seed: int
    policy: SyncPolicy
    agents: Agents
    network: NetworkFederate
    coordinator: Coordinator
    federates: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> "Simulation":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the external federates; otherwise they end when they are not referenced any more."""
        self.federates.close()

    def run(self, until_ns: int | None = None, progress: Progress | None = None) -> Run:
        """Simulate until a time, or until the scenario's end, and return the record so far.

        Args:
            until_ns: End time in nanoseconds of simulated time, or None.
            progress: As for `Coordinator.advance`.

        Raises:
            PolicyError: The policy has no window. `coordinator.run` has the record so far, also after other errors.
            FederateError: Physics, network or a program failed, or did not answer in time.
        """
        return self.coordinator.advance(self.scenario.duration_ns if until_ns is None else until_ns, progress)


def build(
    scenario: CosimScenario,
    *,
    policy: str | SyncPolicy | None = None,
    seed: int | None = None,
    recorder: WindowObserver | None = None,
    deadline_s: float | None = DEADLINE_S,
    physics: PhysicsFederate | None = None,
    network: NetworkFederate | None = None,
    measures_all: bool = False,
) -> Simulation:
    """Return a scenario as a simulation.

    Args:
        scenario: The scenario.
        policy: A sync policy or the name of one; None for the scenario's.
        seed: Seed of all random draws; None for the scenario's first.
        recorder: Receives every window, and every IP packet if it has `log_ip`; or None.
        deadline_s: Longest wait for an answer of a federate, in seconds of wall time; None for no deadline.
        physics: Replaces the scenario's physics, and receives the commands to bodies.
        network: Replaces the scenario's network; faults of the radio are then its responsibility.
        measures_all: As for `Coordinator`.

    Raises:
        ConfigurationError: The scenario cannot be run; the message says why.
        FederateError: An external federate failed, or has not connected or answered in time.
    """
    seed = scenario.seeds[0] if seed is None else seed
    if policy is None or isinstance(policy, str):
        policy = make_policy(scenario.policy.name if policy is None else policy, **scenario.policy.parameters)
    world = load_world(scenario.world)
    check(scenario, world, lambda location: f"scenario {scenario.name}: {'.'.join(map(str, location))}")
    with ExitStack() as federates:
        scenario_bodies = bodies(scenario, world)
        details = scenario, world, scenario_bodies, seed, deadline_s
        if physics is None and (remote_physics := open_physics(*details)) is not None:
            federates.callback(remote_physics.close)
            physics = remote_physics
        if network is None and (remote_network := open_network(*details)) is not None:
            federates.callback(remote_network.close)
            network = remote_network
        if physics is None:
            physics = Bodies(scenario_bodies, world, step_ns=scenario.physics.step_ns)
        if network is None:
            network = radio_network(scenario, world, seed, recorder)
        for fault in scenario.faults:
            if isinstance(fault, StalledFederateFault):
                stall = Stall(fault.begin_ns, fault.stall, deadline_s)
                if fault.federate == "physics":
                    physics = stalled(physics, stall)
                else:
                    network = stalled(network, stall)
        scenario_programs = programs(
            scenario, seed, controllers(scenario, scenario_bodies, seed), stops(scenario_bodies)
        )
        agents = Agents(physics, scenario_programs)
        coordinator = Coordinator(
            agents, network, policy, scenario.pairs, observer=recorder, measures_all=measures_all
        )
        return Simulation(scenario, seed, policy, agents, network, coordinator, federates.pop_all())
