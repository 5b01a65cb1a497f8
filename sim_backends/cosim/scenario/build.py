"""Builds the simulation of a scenario: agents, network and coordinator.

The network consists of antennas, a radio model and transports, with the faults of radios.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from fieldkit.core.model import Topology
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.federates import NetworkFederate, PhysicsFederate
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.programs.senders import REPLY
from sim_backends.cosim.recording.captures import CapturedFlow, PacketObserver, assign_addresses
from sim_backends.cosim.run_record import IpObserver, Run, WindowObserver
from sim_backends.cosim.scenario.agent_plans import FileTraffic, PingTraffic, QosOptions, Traffic
from sim_backends.cosim.scenario.agent_setup import (
    antennas_of,
    make_bodies,
    make_controllers,
    make_programs,
    stop_commands,
)
from sim_backends.cosim.scenario.checks import check
from sim_backends.cosim.scenario.external import carried_radio, open_network, open_physics, writes_captures
from sim_backends.cosim.scenario.faults import JammerFault, LinkCutFault, NodeLossFault, StalledFederateFault
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.wall_time import DEADLINE_S, Progress, Stall, with_stall
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss
from sim_backends.network.ip import Fragment
from sim_backends.network.radio import RadioNetwork, TransportFactory
from sim_backends.network.ros1.ros1_options import Ros1Flow, Ros1Options
from sim_backends.network.ros1.ros1_transport import Ros1
from sim_backends.network.tcp.connection import Tcp
from sim_backends.network.tcp.tcp_options import TcpOptions
from sim_backends.network.topics.discovery import DiscoveryTiming
from sim_backends.network.topics.qos import Qos, TopicFlow
from sim_backends.network.topics.rtps_transport import Topics
from sim_backends.network.udp import Udp
from sim_backends.physics.bodies import Bodies
from sim_backends.radio.core.random_streams import RandomStream
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.models.radio_model import PathLosses, RadioModel, WifiInWorld
from sim_backends.world.world import World, load_world

_STARTS_WITHIN_NS: Final = 100_000_000
"""Interval in which the participants of topics start. If all started at one time, all their multicast packets and
retransmissions would collide."""


def radio_network(
    scenario: CosimScenario,
    world: World,
    seed: int,
    observer: WindowObserver | None = None,
    path_losses_db: PathLosses | None = None,
    *,
    carrier: NetworkFederate | None = None,
) -> RadioNetwork:
    """Return the network that carries the packets of a scenario, which must have passed `checks`.

    Args:
        scenario: The scenario.
        world: Its world.
        seed: Seed of all random draws.
        observer: Receives all IP packets if it has `log_ip`; or None.
        path_losses_db: Returns the mean losses that replace losses in the world, by transmitter and receiver; None if
            there are none. Fixed links ignore them.
        carrier: Network that carries its IP packets instead of the built-in radio, or None.
    """
    stations = antennas_of(scenario)
    radio: RadioModel[Fragment]
    if carrier is not None:
        radio = carried_radio(carrier, tuple(stations))
    elif scenario.radio.is_fixed:
        radio = UniformLinks(seed, scenario.radio)
    else:
        radio = WifiInWorld(seed, scenario.radio, stations, world, path_losses_db=path_losses_db)
    network = RadioNetwork(
        radio,
        tuple(stations),
        transports=_transports(scenario, seed),
        disturbances=tuple(_disturbances(scenario, world)),
        relay=scenario.relay if scenario.topology is Topology.MASTER else None,
    )
    if scenario.relay is not None:  # even if this agent does not relay, it transmits as the host of the ROS 1 master
        network.transmitters |= {scenario.relay}
    if isinstance(observer, IpObserver):
        network.log_ip(observer.log_ip)
    return network


def captured_flows(traffic: Iterable[Traffic]) -> dict[str, CapturedFlow]:
    """Return the flows of a scenario whose packets have special headers in captures: pings, and given ports."""
    flows: dict[str, CapturedFlow] = {}
    for entry in traffic:
        for flow in entry.flows:
            if isinstance(entry, PingTraffic) and entry.protocol == "udp":
                flows |= {flow: CapturedFlow(ping=flow), flow + REPLY: CapturedFlow(ping=flow, is_reply=True)}
            elif isinstance(entry, FileTraffic) and entry.port is not None:
                flows[flow] = CapturedFlow(port=entry.port)
    return flows


def _captures(scenario: CosimScenario, folder: Path) -> dict[str, Any] | None:
    """Return the settings with which an external network writes captures like those of the class `Captures`.

    The result is None if the network writes no captures.
    """
    if not writes_captures(scenario):
        return None
    flows = captured_flows(scenario.traffic)
    pings = list(dict.fromkeys(flow.ping for flow in flows.values() if flow.ping))
    return {
        "folder": str(folder.absolute()),
        "addresses": {name: str(address) for name, address in assign_addresses(sorted(scenario.agents)).items()},
        "flows": {
            name: {
                "port": flow.port or 0,
                "ping": pings.index(flow.ping) + 1 if flow.ping else 0,
                "reply": flow.is_reply,
            }
            for name, flow in flows.items()
        },
    }


def _transports(scenario: CosimScenario, seed: int) -> Mapping[str, TransportFactory]:
    """Return the transports; topics are omitted if no flow uses them, because discovery sends without traffic."""
    topics: dict[str, TopicFlow] = {}
    ros1: dict[str, Ros1Flow] = {}
    for traffic in scenario.traffic:
        for flow, source, destination in traffic.flow_ends:
            if traffic.transport == "topic":
                topics[flow] = TopicFlow(source, destination, _qos(traffic), topic=f"rt/{traffic.title}")
            elif traffic.transport == "ros1":
                ros1[flow] = Ros1Flow(source, destination, "udpros" if traffic.protocol == "ros1-udp" else "tcpros")
    tcp = TcpOptions(congestion=scenario.tcp.congestion)
    transports: dict[str, TransportFactory] = {"udp": Udp, "tcp": partial(Tcp, options=tcp)}
    if topics:
        transports["topic"] = partial(Topics, flows=topics, discovery=_discovery(topics, seed))
    if ros1:
        assert scenario.relay is not None  # guaranteed by the schema
        transports["ros1"] = partial(Ros1, flows=ros1, master=scenario.relay, options=Ros1Options(tcp=tcp))
    return transports


def _discovery(topics: Mapping[str, TopicFlow], seed: int) -> DiscoveryTiming:
    """Return the times at which the participants of topics start discovery; the seed determines them."""
    participants = {end for flow in topics.values() for end in (flow.publisher, flow.subscriber)}
    starts_ns = {
        name: int(RandomStream(seed, name, "participant's start").draw(0) * _STARTS_WITHIN_NS)
        for name in participants
    }
    return DiscoveryTiming(starts_ns=starts_ns)


def _qos(traffic: Traffic) -> Qos:
    options = traffic.qos or QosOptions()
    return Qos(reliability=options.reliability, history=options.history, depth=options.depth)


def _disturbances(scenario: CosimScenario, world: World) -> Iterator[Disturbance]:
    """Yield the disturbances that are caused by faults, and those that switch off the radios of absent agents."""
    stations = antennas_of(scenario)
    for name, lifetime in scenario.lifetimes.items():
        if name not in stations:
            continue
        if lifetime.appears_ns:
            yield NodeLoss(name, 0, lifetime.appears_ns)
        if lifetime.disappears_ns is not None:
            yield NodeLoss(name, lifetime.disappears_ns)
    for fault in scenario.faults:
        match fault:
            case NodeLossFault():
                yield NodeLoss(fault.agent, fault.begin_ns, fault.end_ns)
            case LinkCutFault():
                yield LinkCut(*fault.between, fault.begin_ns, fault.end_ns)
            case JammerFault():
                position_m = None if fault.at_m is None else (*fault.at_m, world.ground_m(fault.at_m) + fault.height)
                yield Jammer(float(fault.power_dbm), fault.begin_ns, fault.end_ns, position_m, fault.agent or "")


def _nothing_to_close() -> None:
    """Do nothing: a federate in this process may have no method `close`."""


@dataclass
class Simulation:
    """A scenario that is ready to run once. As a context manager, it stops its external federates.

    Attributes:
        scenario: The scenario.
        seed: Seed of all random draws.
        policy: Its sync policy.
        agents: Bodies and programs.
        network: Carries packets.
        coordinator: Runs agents and network.
        federates: Context of the external federates; closing it stops them.
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
        """Stop the external federates, which otherwise stop only when this object is deleted."""
        self.federates.close()

    def run(self, until_ns: int | None = None, progress: Progress | None = None) -> Run:
        """Simulate until a time, or until the scenario's end, and return the record so far.

        Args:
            until_ns: End time in nanoseconds of simulated time, or None.
            progress: Called at most every 0.2 s of wall time, or None.

        Raises:
            PolicyError: The policy cannot determine a window.
            FederateError: Physics, network or a program failed, or did not answer in time. After any error,
                `Coordinator.run` has the record so far.
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
    captures: Path | None = None,
) -> Simulation:
    """Return a scenario as a simulation.

    Args:
        scenario: The scenario.
        policy: A sync policy or its name; None for the policy of the scenario.
        seed: Seed of all random draws; None for the first seed of the scenario.
        recorder: Receives every window, and every IP packet if it has `log_ip`; or None. If a network other than the
            built-in one has the transports, the recorder receives the programs' packets as IP packets.
        deadline_s: Longest wait for an answer of a federate, in seconds of wall time; None for no deadline.
        physics: Replaces the scenario's physics, and receives the commands to bodies; None for the scenario's
            physics.
        network: Replaces the scenario's network, and must then also apply the faults of the radio; None for the
            scenario's network.
        measures_all: True to include all agents in the position error of every packet, as comparisons need.
        captures: Folder of captures for a network that writes them itself, or None. If the network writes captures,
            the recorder receives no IP packets.

    Raises:
        ConfigurationError: The scenario cannot be run; the message states the reason.
        FederateError: An external federate failed, or has not connected or answered in time.
    """
    seed = scenario.seeds[0] if seed is None else seed
    if policy is None or isinstance(policy, str):
        policy = make_policy(scenario.policy.name if policy is None else policy, **scenario.policy.parameters)
    world = load_world(scenario.world)
    check(scenario, world, lambda location: f"scenario {scenario.name}: {'.'.join(map(str, location))}")
    with ExitStack() as federates:
        scenario_bodies = make_bodies(scenario, world)
        federate_arguments = scenario, world, scenario_bodies, seed, deadline_s
        if physics is None and (physics := open_physics(*federate_arguments)) is not None:
            federates.callback(getattr(physics, "close", _nothing_to_close))
        captures_settings = None if network is not None or captures is None else _captures(scenario, captures)
        carrier = open_network(*federate_arguments, captures=captures_settings) if network is None else None
        federates.callback(getattr(carrier, "close", _nothing_to_close))
        # `federate`: the external network has the transports, so it is the complete network. `builtin`: it only
        # carries the IP packets of the built-in transports.
        if scenario.network.transports == "federate":
            network = network or carrier
        if physics is None:
            physics = Bodies(scenario_bodies, world, step_ns=scenario.physics.step_ns, lifetimes=scenario.lifetimes)
        if network is None:
            losses_db = partial(getattr, physics, "path_losses_db") if hasattr(physics, "path_losses_db") else None
            network = radio_network(scenario, world, seed, recorder, losses_db, carrier=carrier)
        elif isinstance(recorder, IpObserver) and captures_settings is None:
            recorder = PacketObserver(recorder, recorder.log_ip)
        for fault in scenario.faults:
            if isinstance(fault, StalledFederateFault):
                stall = Stall(fault.begin_ns, fault.stall, deadline_s)
                if fault.federate == "physics":
                    physics = with_stall(physics, stall)
                else:
                    network = with_stall(network, stall)
        scenario_programs = make_programs(
            scenario, seed, make_controllers(scenario, scenario_bodies, seed), stop_commands(scenario_bodies)
        )
        lifetimes = scenario.lifetimes
        starts = Bodies(scenario_bodies, world, lifetimes=lifetimes).start_states() if lifetimes else {}
        agents = Agents(physics, scenario_programs, lifetimes, starts)
        coordinator = Coordinator(
            agents, network, policy, scenario.pairs, observer=recorder, measures_all=measures_all
        )
        return Simulation(scenario, seed, policy, agents, network, coordinator, federates.pop_all())
