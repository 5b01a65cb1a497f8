"""What a scenario is run with: agents, network and coordinator."""

from dataclasses import dataclass

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator, Progress
from sim_backends.cosim.federates import NetworkFederate, PhysicsFederate
from sim_backends.cosim.observer import WindowObserver
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.checks import check
from sim_backends.cosim.scenario.faults import StalledFederateFault
from sim_backends.cosim.scenario.networks import radio_network
from sim_backends.cosim.scenario.policies import make_policy
from sim_backends.cosim.scenario.programs import programs
from sim_backends.cosim.scenario.robots import bodies
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.steering import controllers, stops
from sim_backends.cosim.stalls import DEADLINE_S, Stall, stalled
from sim_backends.physics.bodies import Bodies
from sim_backends.world.world import load_world


@dataclass
class Simulation:
    """A scenario that is ready to run, once.

    Attributes:
        scenario: What it was built from.
        seed: Of its random draws.
        policy: Its sync policy.
        agents: Bodies and programs.
        network: Carries packets.
        coordinator: Runs both.
    """

    scenario: CosimScenario
    seed: int
    policy: SyncPolicy
    agents: Agents
    network: NetworkFederate
    coordinator: Coordinator

    def run(self, until_ns: int | None = None, progress: Progress | None = None) -> Run:
        """Go on until a time, or to the scenario's end; return what was recorded so far.

        Args:
            until_ns: Until when, in nanoseconds of simulated time.
            progress: Is told how far it is, now and then.

        Raises:
            PolicyError: The policy has no window; what was recorded is in `coordinator.run`, as below.
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
        policy: Its sync policy, or the name of one; None for the scenario's.
        seed: Of all random draws; None for the scenario's first.
        recorder: Is told of every window, and handed every IP packet if it takes them; None for nobody.
        deadline_s: Longest wait of a federate for an answer, in seconds of wall time; None for no deadline.
        physics: Moves the agents in the place of the built-in bodies, of which it gets the commands.
        network: Carries packets in the place of the built-in radio; faults of the radio are then its own.
        measures_all: As of `Coordinator`.

    Raises:
        ConfigurationError: It cannot be run; says why.
    """
    seed = scenario.seeds[0] if seed is None else seed
    if policy is None or isinstance(policy, str):
        policy = make_policy(scenario.policy.name if policy is None else policy, **scenario.policy.parameters)
    world = load_world(scenario.world)
    check(scenario, world, lambda place: f"scenario {scenario.name}: {'.'.join(map(str, place))}")
    its_bodies = bodies(scenario, world)
    running = programs(scenario, seed, controllers(scenario, its_bodies, seed), stops(its_bodies))
    moves = physics or Bodies(its_bodies, world, step_ns=scenario.physics.step_ns)
    carries = network or radio_network(scenario, world, seed, recorder)
    for fault in scenario.faults:
        if isinstance(fault, StalledFederateFault):
            stall = Stall(fault.begin_ns, fault.stall, deadline_s)
            if fault.federate == "physics":
                moves = stalled(moves, stall)
            else:
                carries = stalled(carries, stall)
    agents = Agents(moves, running)
    coordinator = Coordinator(
        agents,
        carries,
        policy,
        scenario.pairs,
        observer=recorder,
        measures_all=measures_all,
    )
    return Simulation(scenario, seed, policy, agents, carries, coordinator)
