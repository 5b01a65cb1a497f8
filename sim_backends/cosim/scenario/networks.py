"""The network of a scenario: antennas, radio model, transports, and faults of radios."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Final

from fieldkit.core.model import Topology
from sim_backends.cosim.run_record import IpObserver, WindowObserver
from sim_backends.cosim.scenario.agent_plans import QosOptions, Traffic
from sim_backends.cosim.scenario.agent_setup import antennas
from sim_backends.cosim.scenario.faults import JammerFault, LinkCutFault, NodeLossFault
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss
from sim_backends.network.ip import Fragment
from sim_backends.network.radio import RadioNetwork, TransportFactory
from sim_backends.network.ros1.options import Ros1Flow, Ros1Options
from sim_backends.network.ros1.transport import Ros1
from sim_backends.network.tcp.connection import Tcp
from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.topics.discovery import DiscoveryTiming
from sim_backends.network.topics.qos import Qos, TopicFlow
from sim_backends.network.topics.transport import Topics
from sim_backends.network.udp import Udp
from sim_backends.radio.fixed_links import UniformLinks
from sim_backends.radio.model import RadioModel, WifiInWorld
from sim_backends.radio.random_streams import RandomStream
from sim_backends.world.world import World

_STARTS_WITHIN_NS: Final = 100_000_000
"""Interval in which the participants of topics start. If all started at one time, their multicasts would collide, and
so would all retransmissions."""


def radio_network(
    scenario: CosimScenario, world: World, seed: int, observer: WindowObserver | None = None
) -> RadioNetwork:
    """Return the network that carries the packets of a scenario, which must have passed `checks`.

    Args:
        scenario: The scenario.
        world: Its world.
        seed: Seed of all random draws.
        observer: Receives all IP packets if it has `log_ip`.
    """
    stations = antennas(scenario)
    radio: RadioModel[Fragment] = (
        UniformLinks(seed, scenario.radio)
        if scenario.radio.fixed
        else WifiInWorld(seed, scenario.radio, stations, world)
    )
    network = RadioNetwork(
        radio,
        tuple(stations),
        transports=_transports(scenario, seed),
        disturbances=tuple(_disturbances(scenario, world)),
        relay=scenario.relay if scenario.topology is Topology.MASTER else None,
    )
    if scenario.relay is not None:  # even if it does not relay, it transmits as the host of the ROS 1 master
        network.transmitters |= {scenario.relay}
    if isinstance(observer, IpObserver):
        network.log_ip(observer.log_ip)
    return network


def _transports(scenario: CosimScenario, seed: int) -> Mapping[str, TransportFactory]:
    """Return the transports; publish-subscribe ones only if they are used, as they send even without traffic."""
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
    for fault in scenario.faults:
        match fault:
            case NodeLossFault():
                yield NodeLoss(fault.agent, fault.begin_ns, fault.end_ns)
            case LinkCutFault():
                yield LinkCut(*fault.between, fault.begin_ns, fault.end_ns)
            case JammerFault():
                place_m = None if fault.at_m is None else (*fault.at_m, world.ground_m(fault.at_m) + fault.height)
                yield Jammer(float(fault.power_dbm), fault.begin_ns, fault.end_ns, place_m, fault.agent or "")
