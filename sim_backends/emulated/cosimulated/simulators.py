"""Builds the physics simulator and the network of a session of the co-simulation."""

import dataclasses
import json
import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, Self

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Topology
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.emulated.cosimulated.velocity_flights import VelocityFlights
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.federates import remote
from sim_backends.federates.frames import NETWORK, PHYSICS
from sim_backends.federates.handshake import AgentStart, Hello
from sim_backends.federates.named import PythonFederate, named_federate
from sim_backends.federates.protocols import PhysicsFederate
from sim_backends.network.bare_ip import BROADCAST, UNICAST, BareBroadcast, BareIp
from sim_backends.network.ip import Fragment
from sim_backends.network.radio import RadioNetwork, TransportFactory
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.quadrotor import Quadrotor
from sim_backends.physics.robot_limits import DriveLimits, QuadrotorLimits
from sim_backends.radio.antennas import Antenna
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.models.radio_model import RadioModel, WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State
from sim_backends.world.world import World

KINEMATIC: Final = "kinematic"
BUILTIN: Final = "builtin"

DEADLINE_S: Final = 10.0
"""Longest wait for an answer of a simulator; shorter than the 15 s for which the lab waits for the medium process."""

_END_NS: Final = 10**9 * 10**8
"""End of the run that is announced to the simulators: three years, because the real end is not known in advance."""


class Simulators(NamedTuple):
    """The simulators of a lab. A federate is a simulator that takes part in a co-simulation.

    Attributes:
        physics: `kinematic`, or a name or command of a physics federate.
        network: `builtin`, or a command of a network federate.
        step_ns: Step of the physics simulator.
        network_options: Options of the network federate; None if it has none.
        physics_options: Options of the physics federate; None if it has none.
    """

    physics: str
    network: str
    step_ns: int = 1_000_000
    network_options: Mapping[str, Any] | None = None
    physics_options: Mapping[str, Any] | None = None


@dataclasses.dataclass(frozen=True)
class RobotBody:
    """The body of a robot.

    Attributes:
        profile: Name of its profile.
        limits: Limits and size; those of a quadrotor if it flies.
    """

    profile: str
    limits: DriveLimits | QuadrotorLimits

    @property
    def flies(self) -> bool:
        """True if it is a drone."""
        return isinstance(self.limits, QuadrotorLimits)

    def to_json(self) -> dict[str, Any]:
        """Return the body as JSON."""
        return {"profile": self.profile, "flies": self.flies, "limits": dataclasses.asdict(self.limits)}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the body from the JSON of `to_json`."""
        limits: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in data["limits"].items()
        }
        return cls(data["profile"], QuadrotorLimits(**limits) if data["flies"] else DriveLimits(**limits))


@dataclasses.dataclass(frozen=True)
class LabSettings:
    """Settings of a session that both simulators have in common.

    Attributes:
        simulators: The simulators.
        seed: Seed of all random draws.
        options: Options of the radio.
        world: The world; None for open ground.
        antennas: Antenna of each station.
        bodies: Body of each robot; the laptop has none.
        relay: Station whose access point relays; None for direct links.
    """

    simulators: Simulators
    seed: int
    options: RadioOptions
    world: World | None
    antennas: Mapping[str, Antenna]
    bodies: Mapping[str, RobotBody]
    relay: str | None


def start_physics(settings: LabSettings, states: Mapping[str, State]) -> PhysicsFederate:
    """Start the physics simulator with robots at rest.

    Args:
        settings: Settings of the session.
        states: State of the antenna of each robot.

    Raises:
        ConfigurationError: A robot overlaps something, or the simulator cannot be used.
        FederateError: The simulator failed, or has not answered in time.
    """
    name, step_ns = settings.simulators.physics, settings.simulators.step_ns
    if name == KINEMATIC:
        bodies = {robot: _body(settings.bodies[robot].limits, state) for robot, state in states.items()}
        return Bodies(bodies, settings.world, step_ns=step_ns)
    hello = _hello(settings, PHYSICS, states)
    federate = named_federate(name, PHYSICS)
    if isinstance(federate, PythonFederate):
        python_physics: PhysicsFederate = federate.load().make(hello)
        return python_physics
    physics = remote.open_physics(name, hello, DEADLINE_S)
    if physics.step_ns != step_ns:
        physics.close()
        raise ConfigurationError(
            f"{physics.session.name} has a step of {physics.step_ns} ns instead of {step_ns} ns",
            remedy=f"configure a step of {step_ns} ns in the simulator's world",
        )
    drones = {
        robot: body
        for robot, state in states.items()
        if isinstance(body := _body(settings.bodies[robot].limits, state), Quadrotor)
    }
    return VelocityFlights(physics, drones, settings.world) if drones else physics


def _body(limits: DriveLimits | QuadrotorLimits, state: State) -> DifferentialDrive | Quadrotor:
    (east_m, north_m, up_m), heading_rad = state.position_m, state.heading_rad or 0.0
    if isinstance(limits, QuadrotorLimits):
        return Quadrotor(limits, (east_m, north_m, up_m - ANTENNA_M), heading_rad, antenna_m=ANTENNA_M)
    return DifferentialDrive(limits, (east_m, north_m), heading_rad, antenna_m=ANTENNA_M)


class BuiltinNetwork(NamedTuple):
    """The built-in network.

    Attributes:
        federate: The network.
        radio: Its radio, which has counters, link samples and a log of transmissions.
    """

    federate: RadioNetwork
    radio: RadioModel[Fragment]


def builtin_network(settings: LabSettings) -> BuiltinNetwork:
    """Return the built-in network, which carries bare IP packets."""
    options, antennas = settings.options, settings.antennas
    radio: RadioModel[Fragment] = (
        UniformLinks(settings.seed, options)
        if options.is_fixed
        else WifiInWorld(settings.seed, options, antennas, settings.world)
    )
    radio.use_meter()
    transports: dict[str, TransportFactory] = {UNICAST: BareIp, BROADCAST: BareBroadcast}
    return BuiltinNetwork(RadioNetwork(radio, tuple(antennas), transports=transports, relay=settings.relay), radio)


def start_network(settings: LabSettings, states: Mapping[str, State]) -> remote.RemoteNetwork:
    """Start the program of a network.

    Args:
        settings: Settings of the session.
        states: State of the antenna of each station.

    Raises:
        ConfigurationError: The program cannot be started, or does not carry the packets of real programs.
        FederateError: The program failed, or has not answered in time.
    """
    network = remote.open_network(settings.simulators.network, _hello(settings, NETWORK, states), DEADLINE_S)
    supported_transports = network.welcome.transports
    if supported_transports and not {UNICAST, BROADCAST} <= {*supported_transports}:
        network.close()
        raise ConfigurationError(
            f"{network.session.name} does not carry bare IP packets, which real programs send",
            remedy=f"use network: {BUILTIN}",
        )
    return network


def _hello(settings: LabSettings, role: int, states: Mapping[str, State]) -> Hello:
    """Return the first message to a simulator: the run, the agents and the configuration."""
    agents = [
        AgentStart(
            name,
            settings.bodies[name].profile if name in settings.bodies else "",
            state._replace(heading_rad=state.heading_rad or 0.0),
            flies=name in settings.bodies and settings.bodies[name].flies,
            antenna_m=ANTENNA_M,
            limit_m_s2=math.inf,
        )
        for name, state in states.items()
    ]
    simulators = settings.simulators
    options = simulators.network_options if role == NETWORK else simulators.physics_options
    configuration = _configuration(settings, states) | {"options": options or {}}
    return Hello(
        role, agents, settings.seed, settings.simulators.step_ns, _END_NS, "lab", json.dumps(configuration).encode()
    )


def _configuration(settings: LabSettings, states: Mapping[str, State]) -> dict[str, Any]:
    """Return the configuration that a scenario with the same radio, world and robots would have.

    A scenario needs a duration and a robot model of each agent. The values here are placeholders: `Hello` has the end
    of the run, and `robots` has the bodies.
    """
    topology = Topology.MASTERLESS if settings.relay is None else Topology.MASTER
    scenario = CosimScenario.model_validate(
        {
            "name": "lab",
            "summary": "robots of a lab",
            "world": "open" if settings.world is None else settings.world.name,
            "duration": "1s",
            "topology": topology.value,
            "relay": settings.relay,
            "agents": {
                name: {"robot": "turtlebot3_burger", "at_m": [*state.position_m[:2]]}
                for name, state in states.items()
            },
        }
    ).model_copy(update={"radio": settings.options})
    world = settings.world or World.model_validate({"name": "open", "summary": "open ground", "area_m": [1e6, 1e6]})
    return {
        "scenario": scenario.model_dump(mode="json", by_alias=True, exclude_none=True),
        "world": world.model_dump(mode="json", by_alias=True, exclude_none=True),
        "robots": {
            name: {
                "body": dataclasses.asdict(settings.bodies[name].limits) if name in settings.bodies else None,
                "radio": dataclasses.asdict(settings.antennas[name]) if name in settings.antennas else None,
            }
            for name in states
        },
    }
