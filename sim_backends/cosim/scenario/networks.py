"""The network of a scenario: antennas, radio model, transports and what goes wrong with radios."""

from collections.abc import Iterator, Mapping

from fieldkit.core.model import Topology
from sim_backends.cosim.scenario.faults import JammerFault, LinkCutFault, NodeLossFault
from sim_backends.cosim.scenario.robots import antenna
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.network.disturbances import Disturbance, Jammer, LinkCut, NodeLoss
from sim_backends.network.ip import Fragment
from sim_backends.network.radio import RadioNetwork, TransportFactory
from sim_backends.network.udp import Udp
from sim_backends.radio.fixed_links import UniformLinks
from sim_backends.radio.model import RadioModel, WifiInWorld
from sim_backends.world.world import World


def network(scenario: CosimScenario, world: World, seed: int) -> RadioNetwork:
    """Return what carries the packets of a scenario that `checks` has nothing against."""
    antennas = {name: one for name, plan in scenario.agents.items() if (one := antenna(plan)) is not None}
    radio: RadioModel[Fragment] = (
        UniformLinks(seed, scenario.radio)
        if scenario.radio.fixed
        else WifiInWorld(seed, scenario.radio, antennas, world)
    )
    return RadioNetwork(
        radio,
        tuple(antennas),
        transports=_transports(scenario),
        disturbances=tuple(_disturbances(scenario, world)),
        relay=scenario.relay if scenario.topology is Topology.MASTER else None,
    )


def _transports(scenario: CosimScenario) -> Mapping[str, TransportFactory]:  # noqa: ARG001
    return {"udp": Udp}


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
