"""The network of a scenario: antennas, radio model, transports and what goes wrong with radios."""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Final

from fieldkit.core.model import Topology
from sim_backends.cosim.observer import IpObserver, WindowObserver
from sim_backends.cosim.scenario.faults import JammerFault, LinkCutFault, NodeLossFault
from sim_backends.cosim.scenario.robots import antennas
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.cosim.scenario.traffic import QosOptions, Traffic
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss
from sim_backends.network.ip import Fragment
from sim_backends.network.radio import RadioNetwork, TransportFactory
from sim_backends.network.ros1.options import Ros1Flow, Ros1Options
from sim_backends.network.ros1.transport import Ros1
from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.tcp.transport import Tcp
from sim_backends.network.topics.discovery import DiscoveryTiming
from sim_backends.network.topics.qos import Qos, TopicFlow
from sim_backends.network.topics.transport import Topics
from sim_backends.network.udp import Udp
from sim_backends.radio.fixed_links import UniformLinks
from sim_backends.radio.model import RadioModel, WifiInWorld
from sim_backends.radio.random_streams import RandomStream
from sim_backends.world.world import World

_STARTS_NS: Final = 100_000_000
"""Within which time the participants of topics start: in one instant, all their multicasts would meet, and again."""


def radio_network(
    scenario: CosimScenario, world: World, seed: int, observer: WindowObserver | None = None
) -> RadioNetwork:
    """Return what carries the packets of a scenario that `checks` has nothing against.

    Args:
        scenario: The scenario.
        world: Its world.
        seed: Of all random draws.
        observer: Is handed all IP packets, if it takes them.
    """
    stations = antennas(scenario)
    radio: RadioModel[Fragment] = (
        UniformLinks(seed, scenario.radio)
        if scenario.radio.fixed
        else WifiInWorld(seed, scenario.radio, stations, world)
    )
    found = RadioNetwork(
        radio,
        tuple(stations),
        transports=_transports(scenario, seed),
        disturbances=tuple(_disturbances(scenario, world)),
        relay=scenario.relay if scenario.topology is Topology.MASTER else None,
    )
    if scenario.relay is not None:  # without an access point it is the host of a ROS 1 master, which talks too
        found.transmitters |= {scenario.relay}
    if isinstance(observer, IpObserver):
        found.log_ip(observer.log_ip)
    return found


def _transports(scenario: CosimScenario, seed: int) -> Mapping[str, TransportFactory]:
    """Return every transport, those of publish-subscribe only where they are used: they talk by themselves."""
    topics: dict[str, TopicFlow] = {}
    ros1: dict[str, Ros1Flow] = {}
    for one in scenario.traffic:
        for flow, source, destination in one.flow_ends:
            if one.transport == "topic":
                topics[flow] = TopicFlow(source, destination, _qos(one), topic=f"rt/{one.title}")
            elif one.transport == "ros1":
                ros1[flow] = Ros1Flow(source, destination, "udpros" if one.protocol == "ros1-udp" else "tcpros")
    tcp = TcpOptions(congestion=scenario.tcp.congestion)
    found: dict[str, TransportFactory] = {"udp": Udp, "tcp": partial(Tcp, options=tcp)}
    if topics:
        found["topic"] = partial(Topics, flows=topics, discovery=_discovery(topics, seed))
    if ros1:
        assert scenario.relay is not None  # by the schema
        found["ros1"] = partial(Ros1, flows=ros1, master=scenario.relay, options=Ros1Options(tcp=tcp))
    return found


def _discovery(topics: Mapping[str, TopicFlow], seed: int) -> DiscoveryTiming:
    participants = {end for flow in topics.values() for end in (flow.publisher, flow.subscriber)}
    starts_ns = {
        name: int(RandomStream(seed, name, "participant's start").draw(0) * _STARTS_NS) for name in participants
    }
    return DiscoveryTiming(starts_ns=starts_ns)


def _qos(one: Traffic) -> Qos:
    said = one.qos or QosOptions()
    return Qos(reliability=said.reliability, history=said.history, depth=said.depth)


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
