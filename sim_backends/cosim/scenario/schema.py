"""The schema of a scenario file. Checks that need more than the file are in `checks`."""

from collections.abc import Iterator
from typing import Annotated, Any, Final, Literal

from fieldkit.config import schema
from fieldkit.config.antennas import AntennaOptions
from fieldkit.config.catalog import Named
from fieldkit.config.schema import AfterValidator, Duration, Field, Int, Length, Location, Strict
from fieldkit.config.wifi_phy import WifiPhy, check_standard
from fieldkit.core.errors import did_you_mean
from fieldkit.core.model import Scenario as Sight
from fieldkit.core.model import Topology
from sim_backends.cosim.policies.registry import policies, unknown_policy_remedy
from sim_backends.cosim.programs.way_points import PERIOD_NS
from sim_backends.cosim.scenario.agent_plans import FollowPlan, MotionPlan, Name, StandingPlan, StreamTraffic, Traffic
from sim_backends.cosim.scenario.faults import ClockSkewFault, Fault, JammerFault
from sim_backends.cosim.scenario.federate_choice import (
    Federate,
    NetworkFederateOptions,
    PhysicsFederateOptions,
    agent_references,
    unsupported,
)
from sim_backends.cosim.scenario.reproduced_trial import ReproducedTrial
from sim_backends.emane_events.options import EmaneOptions
from sim_backends.network.tcp.tcp_options import Congestion
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import Lifetime
from sim_backends.world.obstacles import Place, Real


def _check_policy_name(name: str) -> str:
    if name not in policies():
        raise schema.validation_error(f"there is no sync policy {name!r}; {unknown_policy_remedy(name)}")
    return name


def _list_policies(json_schema: dict[str, Any]) -> None:
    json_schema["enum"] = [*policies()]


class PolicyChoice(Strict):
    """The sync policy of a scenario.

    Its parameters apply to every policy that has them, also in `fieldkit cosim shootout`.

    Attributes:
        name: The default policy of a run.
        window: Length of a window; for the velocity-aware policies, the window w of two agents at rest.
        longest: Longest window of policies with variable windows.
        bound: For `error_bounded`: largest error of the relative position of two agents, as the network assumes it.
        bound_db: Instead of `bound`: largest error of the path loss between two agents in free line of sight, in dB.
        exponent: Exponent of the log-distance law for `bound_db`.
    """

    name: Annotated[str, AfterValidator(_check_policy_name), Field(json_schema_extra=_list_policies)] = "event_driven"
    window: Annotated[Duration, Field(gt=0)] = 0.001
    longest: Annotated[Duration, Field(gt=0)] = 0.1
    bound: Annotated[Length, Field(gt=0)] = 0.01
    bound_db: Annotated[Real | None, Field(gt=0)] = None
    exponent: Annotated[Real, Field(gt=0, le=10)] = 3.0

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters with the names that policies use, in SI units."""
        parameters = {"window_s": self.window, "longest_s": self.longest, "bound_m": self.bound}
        return (
            parameters
            if self.bound_db is None
            else parameters | {"bound_db": self.bound_db, "exponent": self.exponent}
        )


class PhysicsOptions(Strict):
    """The physics of a scenario.

    Attributes:
        step: Its time step.
        federate: An [external federate](federates.md) that replaces the built-in physics: the name of an installed
            simulator, a command, or an address of `tcp`, `udp`, `dds` or `ros1` (addresses: `fieldkit docs
            federates`). A command is started for each run of the scenario.
        options: Options of the federate; each [installed simulator](reference/simulator-options.md) has a table of
            its options.
    """

    step: Annotated[Duration, Field(ge=1e-6, le=1)] = 0.001
    federate: Federate = None
    options: PhysicsFederateOptions = None

    @property
    def step_ns(self) -> int:
        """Its time step in nanoseconds."""
        return round(self.step * 1e9)


class NetworkOptions(Strict):
    """The network of a scenario.

    Attributes:
        federate: An [external federate](federates.md) that replaces the built-in network, as for the physics. It is
            then responsible for the radio, the faults of radios and, unless `transports` is `builtin`, `tcp`.
        options: Options of the federate, as for the physics.
        transports: `federate`: the transports of the federate. `builtin`: the built-in UDP, TCP, topics and ROS 1,
            whose IP packets the federate carries with its transport `ip`.
    """

    federate: Federate = None
    options: NetworkFederateOptions = None
    transports: Literal["federate", "builtin"] = "federate"


TX_POWERS_DBM: Final = (-50, 50)
"""Smallest and largest transmit power of an agent."""


class AgentRadio(Strict):
    """The radio of an agent.

    Attributes:
        standard: Its IEEE standard; with `phy` also its band, `802.11ac 5 GHz`.
        tx_power_dbm: Its transmit power.
        sensitivity_dbm: Power of the weakest frame that it detects.
        phy: Physical layer of 802.11n, ac or ax, as `radio.phy` of a [robot profile](reference/robot-profile.md); if
            omitted, that of `standard` with one stream in 20 MHz.
        antenna: Pattern and orientation of its antenna, as `radio.antenna` of a robot profile; isotropic if omitted.
    """

    standard: str = "802.11n"
    tx_power_dbm: Annotated[Real, Field(ge=TX_POWERS_DBM[0], le=TX_POWERS_DBM[1])] = 17
    sensitivity_dbm: Annotated[Real, Field(ge=-120, le=0)] = -82
    phy: WifiPhy | None = None
    antenna: AntennaOptions | None = None

    @schema.model_validator(mode="after")
    def _check_standard(self) -> "AgentRadio":
        if self.phy is None and self.standard not in {"802.11g", "802.11n"}:
            raise schema.validation_error(
                f"without phy there is no standard {self.standard!r}; write 802.11g or 802.11n, or add phy",
                "standard",
            )
        check_standard(self.standard, self.phy)
        return self


class AgentPlan(Strict):
    """An agent of a scenario.

    Attributes:
        robot: A kind of body, or a robot profile, which also has a radio.
        at_m: Start position, metres east and north.
        along: Instead of `at_m`: start position on the line of the world file, as a distance from the beginning of
            the line.
        aside_m: Distance of the start from that line, to the left.
        height: Height of the start above the ground, for agents that fly.
        heading_deg: Initial heading, from east towards north.
        radio: Its radio, instead of the radio of its robot profile.
        motion: Its motion.
        phase: Time of its controller's first command, less than the 50 ms between commands; random if omitted.
        appears: Time when it appears at its start. Its motion begins at this time, and its traffic at this time or
            later.
        disappears: Time when it disappears; never if omitted.
    """

    robot: str
    at_m: Place | None = None
    along: Length | None = None
    aside_m: Real = 0
    height: Length = 0.0
    heading_deg: Real = 0
    radio: AgentRadio | None = None
    motion: MotionPlan = StandingPlan.defaults()
    phase: Annotated[Duration | None, Field(lt=PERIOD_NS / 1e9)] = None
    appears: Duration = 0.0
    disappears: Duration | None = None

    @property
    def lifetime(self) -> Lifetime:
        """The time in which it exists."""
        return Lifetime(round(self.appears * 1e9), None if self.disappears is None else round(self.disappears * 1e9))

    @schema.model_validator(mode="after")
    def _disappears_after_it_appears(self) -> "AgentPlan":
        if self.disappears is not None and self.disappears <= self.appears:
            raise schema.validation_error(
                f"the agent disappears at {self.disappears:g} s, but appears only at {self.appears:g} s",
                "disappears",
            )
        return self

    @schema.model_validator(mode="after")
    def _one_start(self) -> "AgentPlan":
        if (self.at_m is None) == (self.along is None):
            raise schema.validation_error(
                "an agent needs either at_m: [EAST, NORTH], or along: 20m, a distance on the line of the world file"
            )
        return self


class TcpChoice(Strict):
    """The TCP of all agents.

    Attributes:
        congestion: Congestion control and loss recovery: `cubic` as in Linux, `cubic-rfc9438`, or `newreno`.
    """

    congestion: Congestion = "cubic"


class CosimScenario(Named):
    """A scenario of the [co-simulation](cosim.md): one YAML file in `scenarios/` of the lab, or a shipped one.

    `fieldkit cosim schema` prints its JSON schema, with which an editor completes and checks it, see [the Python
    API](cosim-api.md#scenario-files). `robot` of an agent is the name of a robot profile, or of a built-in body:
    `husky`, `iris`, `turtlebot3_burger` or `duckiedrone`. Only a profile has a radio. A profile of another name has
    the body of the TurtleBot, or of the Duckiedrone if it flies, with its own top speed. `radio` has the same keys
    as `emulated.radio` in the [site file](reference/site-file.md).

    Attributes:
        name: The file's name without `.yaml`.
        summary: Description in one line.
        world: Surroundings of the agents: a file of the lab's folder `worlds/`, or a shipped one.
        line: The line of the world file along which agents start: `los` (line of sight) or `nlos` (no line of sight).
        duration: Duration of a run, in simulated time.
        seeds: Seeds of the random draws, one for each run.
        physics: The physics simulator.
        network: The network simulator.
        radio: The radio model.
        tcp: The TCP of all agents, also for ROS 1 topics.
        topology: `masterless`, or `master`: all packets go through the relay.
        relay: The agent that runs the ROS 1 master, if any; with `master`, its access point also relays all packets.
        policy: The [sync policy](method-cosim.md#sync-policies).
        emane: If given, a run publishes the positions of its agents to the network emulator [EMANE](emane.md). With
            the physics federate `emane`, it reads them from EMANE's events instead.
        agents: The agents by name.
        traffic: The traffic between the agents.
        faults: Faults during a run.
        trial: The trial of robots that the scenario reproduces.
    """

    world: str
    line: Sight = Sight.LOS
    duration: Annotated[Duration, Field(gt=0, le=1e6)]
    seeds: Annotated[tuple[Annotated[Int, Field(ge=0)], ...], Field(min_length=1)] = (1,)
    physics: PhysicsOptions = PhysicsOptions.defaults()
    network: NetworkOptions = NetworkOptions.defaults()
    radio: RadioOptions = RadioOptions.defaults()
    tcp: TcpChoice = TcpChoice.defaults()
    topology: Topology = Topology.MASTERLESS
    relay: Name | None = None
    policy: PolicyChoice = PolicyChoice.defaults()
    emane: EmaneOptions | None = None
    agents: Annotated[dict[Name, AgentPlan], Field(min_length=1)]
    traffic: tuple[Traffic, ...] = ()
    faults: tuple[Fault, ...] = ()
    trial: Annotated[ReproducedTrial | None, Field(exclude_if=schema.is_empty)] = None

    @property
    def duration_ns(self) -> int:
        """Its duration in nanoseconds of simulated time."""
        return round(self.duration * 1e9)

    @property
    def lifetimes(self) -> dict[str, Lifetime]:
        """The lifetimes of the agents that exist only during a part of the run."""
        lifetimes = {name: plan.lifetime for name, plan in self.agents.items()}
        return {name: lifetime for name, lifetime in lifetimes.items() if lifetime != Lifetime()}

    @property
    def packets(self) -> float:
        """The approximate maximum number of packets of its programs in a run."""
        return sum(traffic.packets(self.duration) for traffic in self.traffic)

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Sender and receiver of all flows, including the replies to pings, sorted."""
        return tuple(sorted({(source, to) for traffic in self.traffic for _, source, to in traffic.flow_ends}))

    @schema.model_validator(mode="after")
    def _named_agents_exist(self) -> "CosimScenario":
        for name, location in self._agent_names():
            if name not in self.agents:
                hint = did_you_mean(name, self.agents, f"agents: {', '.join(self.agents)}")
                raise schema.validation_error(f"there is no agent {name!r}; {hint}", *location)
        return self

    def _agent_names(self) -> Iterator[tuple[str, Location]]:
        """Yield every reference to an agent, with its keys."""
        if self.relay is not None:
            yield self.relay, ("relay",)
        for number, traffic in enumerate(self.traffic):
            yield traffic.source, ("traffic", number, "from")
            yield from ((name, ("traffic", number, "to")) for name in traffic.to)
        for number, fault in enumerate(self.faults):
            yield from ((name, ("faults", number, key)) for key, name in fault.agents)
        for agent, plan in self.agents.items():
            if isinstance(plan.motion, FollowPlan):
                yield from ((name, ("agents", agent, "motion", "leader")) for name in plan.motion.leader)
        for parent_keys, options in (
            (("physics", "options"), self.physics.options),
            (("network", "options"), self.network.options),
            (("emane",), self.emane),
        ):
            yield from ((name, (*parent_keys, *location)) for name, location in agent_references(options))

    @schema.model_validator(mode="after")
    def _simulators_support_it(self) -> "CosimScenario":
        for options in (self.physics.options, self.network.options):
            for message, location in unsupported(options, self):
                raise schema.validation_error(message, *location)
        return self

    @schema.model_validator(mode="after")
    def _relay_is_named(self) -> "CosimScenario":
        if self.topology is Topology.MASTER and self.relay is None:
            raise schema.validation_error("the topology master needs a relay: AGENT", "topology")
        for number, traffic in enumerate(self.traffic):
            if traffic.transport == "ros1" and self.relay is None:
                raise schema.validation_error(
                    "ros1 needs a master: set its host with relay: AGENT", "traffic", number, "protocol"
                )
        return self

    @schema.model_validator(mode="after")
    def _traffic_names_are_unique(self) -> "CosimScenario":
        titles: set[str] = set()
        for number, traffic in enumerate(self.traffic):
            if traffic.title in titles:
                raise schema.validation_error(
                    f"two entries of the traffic have the name {traffic.title!r}; rename one of them",
                    "traffic",
                    number,
                )
            titles.add(traffic.title)
        return self

    @schema.model_validator(mode="after")
    def _trial_has_its_traffic(self) -> "CosimScenario":
        for message, location in () if self.trial is None else self.trial.problems(self.traffic):
            raise schema.validation_error(message, "trial", *location)
        return self

    @schema.model_validator(mode="after")
    def _seeds_are_different(self) -> "CosimScenario":
        if len(set(self.seeds)) < len(self.seeds):
            raise schema.validation_error("a seed is listed twice, which would give the same run twice", "seeds")
        return self

    @schema.model_validator(mode="after")
    def _one_clock_skew_per_agent(self) -> "CosimScenario":
        agents: set[str] = set()
        for number, fault in enumerate(self.faults):
            if isinstance(fault, ClockSkewFault):
                if fault.agent in agents:
                    raise schema.validation_error(
                        f"{fault.agent} has two clock-skew faults; remove one of them", "faults", number, "agent"
                    )
                agents.add(fault.agent)
        return self

    @schema.model_validator(mode="after")
    def _jammers_have_an_effect(self) -> "CosimScenario":
        for number, fault in enumerate(self.faults):
            if self.radio.is_fixed and isinstance(fault, JammerFault):
                raise schema.validation_error(
                    "fixed links ignore a jammer; remove it, or remove loss, delay, rate and jitter of the radio",
                    "faults",
                    number,
                )
        return self

    @schema.model_validator(mode="after")
    def _followers_receive_their_leaders(self) -> "CosimScenario":
        streams = (traffic for traffic in self.traffic if isinstance(traffic, StreamTraffic))
        streamed_pairs = {(stream.source, to) for stream in streams for to in stream.to}
        for agent, plan in self.agents.items():
            for leader in plan.motion.leader if isinstance(plan.motion, FollowPlan) else ():
                if (leader, agent) not in streamed_pairs:
                    raise schema.validation_error(
                        f"{agent} follows {leader}, but receives no states from it; add to the traffic "
                        f"{{kind: stream, from: {leader}, to: {agent}, rate: 10Hz}}",
                        "agents",
                        agent,
                        "motion",
                    )
        return self

    @schema.model_validator(mode="after")
    def _window_is_at_least_a_step(self) -> "CosimScenario":
        if self.policy.window < self.physics.step:
            raise schema.validation_error(
                f"a window of {self.policy.window:.12g} s is shorter than the physics step, "
                f"{self.physics.step:.12g} s, so that no state changes in it",
                "policy",
                "window",
            )
        return self
