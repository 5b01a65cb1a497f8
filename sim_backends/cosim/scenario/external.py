"""Starts, connects to or creates the external federates of a scenario.

An external federate is a simulator of physics or network that replaces the built-in one. Runs start them only with
this module; `fieldkit cosim conform` starts them itself.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.scenario.agent_setup import antennas_of, limits_of
from sim_backends.cosim.scenario.federate_choice import BUILT_IN
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.federates import remote
from sim_backends.federates.frames import NETWORK, PHYSICS, ROLES
from sim_backends.federates.handshake import AgentStart, FederateCapability, Hello
from sim_backends.federates.ip_radio import IpRadio
from sim_backends.federates.named import ProgramFederate, PythonFederate, federates, named_federate
from sim_backends.federates.protocols import NetworkFederate, PhysicsFederate
from sim_backends.federates.simulator_options import SimulatorOptions, options_json
from sim_backends.federates.transports.transport_table import parse_address
from sim_backends.network.bare_ip import BROADCAST, UNICAST
from sim_backends.network.ip import Fragment
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Body
from sim_backends.radio.models.radio_model import RadioModel
from sim_backends.world.world import World

_BUILT_IN_SUMMARIES: Final = {
    PHYSICS: "robots with differential drives and quadrotors, with limits of velocity and acceleration",
    NETWORK: "802.11g and 802.11n in the world of the scenario, with UDP, TCP, DDS and ROS 1",
}
"""Summary of the built-in physics and network, for lists of simulators."""


def without_federates(scenario: CosimScenario) -> CosimScenario:
    """Return the scenario with the built-in physics and network."""
    return scenario.model_copy(
        update={
            "physics": scenario.physics.model_copy(update={"federate": None, "options": None}),
            "network": scenario.network.model_copy(update={"federate": None, "options": None}),
        }
    )


def has_addresses(scenario: CosimScenario) -> bool:
    """Return True if a federate of the scenario has the address of a transport instead of a command."""
    endpoints = (scenario.physics.federate, scenario.network.federate)
    return any(endpoint is not None and parse_address(endpoint) is not None for endpoint in endpoints)


def writes_captures(scenario: CosimScenario) -> bool:
    """Return True if the network is a program that writes captures of its IP packets."""
    endpoint = None if scenario.network.transports == "builtin" else scenario.network.federate
    federate = None if endpoint is None else named_federate(endpoint, NETWORK)
    return isinstance(federate, ProgramFederate) and federate.writes_captures


def make_hello(scenario: CosimScenario, world: World, bodies: Mapping[str, Body[Any]], seed: int, role: int) -> Hello:
    """Return the first message to an external federate.

    Args:
        scenario: The scenario.
        world: Its world.
        bodies: The body of each agent.
        seed: Seed of all random draws.
        role: `PHYSICS` or `NETWORK`.
    """
    built_in = Bodies(bodies, world, step_ns=scenario.physics.step_ns, lifetimes=scenario.lifetimes)
    states = built_in.start_states()
    agents = [
        AgentStart(
            name,
            plan.robot,
            states[name],
            bodies[name].flies,
            bodies[name].antenna_m,
            built_in.limits_m_s2[name],
        )
        for name, plan in scenario.agents.items()
    ]
    return Hello(
        role,
        agents,
        seed,
        scenario.physics.step_ns,
        scenario.duration_ns,
        scenario.name,
        _configuration(scenario, world, role),
    )


def _configuration(scenario: CosimScenario, world: World, role: int) -> bytes:
    """Return the configuration as JSON; agents are in the order of the scenario, because results may depend on it."""
    radios = antennas_of(scenario)
    options = (scenario.physics if role == PHYSICS else scenario.network).options
    configuration = {
        "scenario": without_federates(scenario).model_dump(mode="json", by_alias=True, exclude_none=True),
        "world": world.model_dump(mode="json", by_alias=True, exclude_none=True),
        "robots": {
            name: {
                "body": dataclasses.asdict(limits_of(plan.robot)),
                "radio": dataclasses.asdict(radios[name]) if name in radios else None,
            }
            for name, plan in scenario.agents.items()
        },
        "options": options_json(options),
    }
    if isinstance(options, SimulatorOptions):
        configuration |= options.further_configuration(configuration)
    return json.dumps(configuration).encode()


class SimulatorName(NamedTuple):
    """A physics or network federate that has a name.

    Attributes:
        name: Its name.
        role: `physics` or `network`.
        summary: Description in one line.
    """

    name: str
    role: str
    summary: str


def simulators() -> list[SimulatorName]:
    """Return the built-in simulators and the simulators of installed packages; none of them is imported.

    Raises:
        ConfigurationError: The package of a simulator cannot be loaded.
    """
    built_in = (SimulatorName(BUILT_IN, ROLES[role], summary) for role, summary in _BUILT_IN_SUMMARIES.items())
    package_simulators = (SimulatorName(name, ROLES[kind.role], kind.summary) for name, kind in federates().items())
    return [*built_in, *package_simulators]


def open_physics(
    scenario: CosimScenario, world: World, bodies: Mapping[str, Body[Any]], seed: int, deadline_s: float | None
) -> PhysicsFederate | None:
    """Start, connect to or create the scenario's external physics federate; return None for the built-in physics.

    Args:
        scenario: The scenario.
        world: Its world.
        bodies: The body of each agent.
        seed: Seed of all random draws.
        deadline_s: Longest wait for an answer, in seconds of wall time; None for no deadline.

    Raises:
        ConfigurationError: The name, the command or the address cannot be used.
        FederateError: The federate failed, or has not connected or answered in time.
    """
    endpoint = scenario.physics.federate
    if endpoint is None:
        return None
    hello = make_hello(scenario, world, bodies, seed, PHYSICS)
    federate = named_federate(endpoint, PHYSICS)
    if isinstance(federate, PythonFederate):
        physics: PhysicsFederate = _make_federate(federate, endpoint, hello)
        return physics
    return remote.open_physics(endpoint, hello, deadline_s)


def open_network(
    scenario: CosimScenario,
    world: World,
    bodies: Mapping[str, Body[Any]],
    seed: int,
    deadline_s: float | None,
    *,
    captures: Mapping[str, Any] | None = None,
) -> NetworkFederate | None:
    """Start, connect to or create the scenario's external network federate; return None for the built-in network.

    Args:
        scenario: The scenario.
        world: Its world.
        bodies: The body of each agent.
        seed: Seed of all random draws.
        deadline_s: Longest wait for an answer, in seconds of wall time; None for no deadline.
        captures: Settings of the captures for a network with `writes_captures`; None if it writes no captures.

    Raises:
        ConfigurationError: The name, the command or the address cannot be used, or the network lacks a transport or a
            capability that the scenario needs.
        FederateError: The federate failed, or has not connected or answered in time.
    """
    endpoint = scenario.network.federate
    if endpoint is None:
        return None
    hello = make_hello(scenario, world, bodies, seed, NETWORK)
    if captures is not None:
        configuration = json.loads(hello.configuration) | {"captures": captures}
        hello = dataclasses.replace(hello, configuration=json.dumps(configuration).encode())
    federate = named_federate(endpoint, NETWORK)
    if isinstance(federate, PythonFederate):
        network: NetworkFederate = _make_federate(federate, endpoint, hello)
        return network
    network = remote.open_network(endpoint, hello, deadline_s)
    supported_transports = network.welcome.transports
    is_builtin = scenario.network.transports == "builtin"
    used_transports = (
        [UNICAST, BROADCAST] if is_builtin else sorted({traffic.transport for traffic in scenario.traffic})
    )
    if supported_transports and (
        missing_transports := [transport for transport in used_transports if transport not in supported_transports]
    ):
        network.close()
        raise ConfigurationError(
            f"{network.session.name} does not support the transport {', '.join(missing_transports)} of the traffic",
            remedy=f"use a scenario whose traffic uses {', '.join(supported_transports)}, or enable the transport by "
            "an option of the network, or list it in welcome: fieldkit docs federates",
        )
    if is_builtin and not network.welcome.capabilities & FederateCapability.NEXT_EVENT:
        network.close()
        raise ConfigurationError(
            f"{network.session.name} does not report the time of its next event",
            where="network.transports",
            remedy="remove transports: builtin",
        )
    return network


def carried_radio(network: NetworkFederate, names: Sequence[str]) -> RadioModel[Fragment]:
    """Return the radio for built-in transports whose IP packets an external network carries."""
    return IpRadio(network, names)


def _make_federate(federate: PythonFederate, name: str, hello: Hello) -> Any:  # noqa: ANN401 (either role)
    """Return a federate in this process.

    Raises:
        ConfigurationError: The federate does not support the scenario, or required software is not installed.
    """
    service = federate.load()
    try:
        return service.make(hello)
    except ValueError as error:
        raise ConfigurationError(
            f"{ROLES[hello.role]} {name}: {error}", remedy="change the scenario, or use another simulator"
        ) from error
