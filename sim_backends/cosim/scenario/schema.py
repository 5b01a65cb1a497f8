"""What a scenario file may say. What needs more than the file to be judged, `build` judges."""

from collections.abc import Iterator
from typing import Annotated, Literal

from fieldkit.config import schema
from fieldkit.config.catalog import Named
from fieldkit.config.schema import AfterValidator, Duration, Field, Int, Length, Location, Strict
from fieldkit.core.errors import nearest
from fieldkit.core.model import Scenario as Sight
from fieldkit.core.model import Topology
from sim_backends.cosim.programs.beats import PERIOD_NS
from sim_backends.cosim.scenario.faults import ClockSkewFault, Fault, JammerFault
from sim_backends.cosim.scenario.motions import FollowPlan, MotionPlan, StandingPlan
from sim_backends.cosim.scenario.names import Name
from sim_backends.cosim.scenario.policies import POLICIES
from sim_backends.cosim.scenario.traffic import StreamTraffic, Traffic
from sim_backends.network.tcp.options import Congestion
from sim_backends.radio.options import RadioOptions
from sim_backends.world.obstacles import Place, Real


def _known_policy(name: str) -> str:
    if name not in POLICIES:
        hint = nearest(name, POLICIES, f"policies: {', '.join(POLICIES)}")
        raise schema.complaint(f"there is no sync policy {name!r}; {hint}")
    return name


class PolicyChoice(Strict):
    """The sync policy of a scenario; its parameters count for every policy that has them, so in a shootout too.

    Attributes:
        name: Of the policy that a run takes if it is not told another.
        window: Length of a window, or the w of the velocity-aware policies.
        longest: What no window of a policy exceeds whose windows differ.
        bound: By how much the network's relative position of two agents that transmit may be wrong, for
            `error_bounded`.
        bound_db: Instead: by how much it may be wrong about the path loss between them in the open, in dB.
        exponent: Of the log-distance law by which `bound_db` is told.
    """

    name: Annotated[str, AfterValidator(_known_policy), Field(json_schema_extra={"enum": [*POLICIES]})] = (
        "event_driven"
    )
    window: Annotated[Duration, Field(gt=0)] = 0.001
    longest: Annotated[Duration, Field(gt=0)] = 0.1
    bound: Annotated[Length, Field(gt=0)] = 0.01
    bound_db: Annotated[Real | None, Field(gt=0)] = None
    exponent: Annotated[Real, Field(gt=0, le=10)] = 3.0

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters as policies name them, in SI units."""
        found = {"window_s": self.window, "longest_s": self.longest, "bound_m": self.bound}
        return found if self.bound_db is None else found | {"bound_db": self.bound_db, "exponent": self.exponent}


class PhysicsOptions(Strict):
    """The physics of a scenario.

    Attributes:
        step: Its own step.
    """

    step: Annotated[Duration, Field(ge=1e-6, le=1)] = 0.001

    @property
    def step_ns(self) -> int:
        """Its own step in nanoseconds."""
        return round(self.step * 1e9)


class AgentRadio(Strict):
    """The radio of an agent.

    Attributes:
        standard: What it speaks.
        tx_power_dbm: Power that it sends with.
        sensitivity_dbm: Weakest frame that it detects.
    """

    standard: Literal["802.11g", "802.11n"] = "802.11n"
    tx_power_dbm: Annotated[Real, Field(ge=-50, le=50)] = 17
    sensitivity_dbm: Annotated[Real, Field(ge=-120, le=0)] = -82


class AgentPlan(Strict):
    """An agent of a scenario.

    Attributes:
        robot: What it is: a kind of body, or a robot profile, which has a radio too.
        at_m: Where it starts, metres east and north.
        along: Instead: how far along the world's line it starts.
        aside_m: How far to the left of that line.
        height: How high over the ground it starts, for those who fly.
        heading_deg: Where it heads at the start, from east towards north.
        radio: Its radio, instead of that of its robot profile.
        motion: What it does.
        phase: When, within the 50 ms from one command to the next, its controller steers first; left out, drawn.
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

    @schema.model_validator(mode="after")
    def _one_start(self) -> "AgentPlan":
        if (self.at_m is None) == (self.along is None):
            raise schema.complaint("it starts either at_m: [EAST, NORTH], or along: 20m of the world's line")
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
    API](cosim-api.md#scenario-files). `robot` is the name of a robot profile, which has a radio. Bodies of `husky`,
    `iris`, `turtlebot3_burger` and `duckiedrone` are built in; another robot has the body of the TurtleBot, or of the
    Duckiedrone, with its own top speed. The keys of `radio` are those of `emulated.radio` in the [site
    file](reference/site-file.md).

    Attributes:
        name: The file's name without `.yaml`.
        summary: One line for people.
        world: What stands around the agents: a file of the lab's own folder `worlds/`, or one that ships.
        line: Which of the world's lines agents start along.
        duration: How long it lasts, in simulated time.
        seeds: Of the random draws, one for each run.
        physics: The physics.
        radio: The radio.
        tcp: The TCP of all agents, also under ROS 1 topics.
        topology: `masterless`, or `master`: everything passes the relay, which is also the host of a ROS 1 master.
        relay: Whose access point relays.
        policy: The sync policy.
        agents: The agents by name.
        traffic: What they send.
        faults: What goes wrong.
    """

    world: str
    line: Sight = Sight.LOS
    duration: Annotated[Duration, Field(gt=0, le=1e6)]
    seeds: Annotated[tuple[Annotated[Int, Field(ge=0)], ...], Field(min_length=1)] = (1,)
    physics: PhysicsOptions = PhysicsOptions.defaults()
    radio: RadioOptions = RadioOptions.defaults()
    tcp: TcpChoice = TcpChoice.defaults()
    topology: Topology = Topology.MASTERLESS
    relay: Name | None = None
    policy: PolicyChoice = PolicyChoice.defaults()
    agents: Annotated[dict[Name, AgentPlan], Field(min_length=1)]
    traffic: tuple[Traffic, ...] = ()
    faults: tuple[Fault, ...] = ()

    @property
    def duration_ns(self) -> int:
        """How long it lasts, in nanoseconds of simulated time."""
        return round(self.duration * 1e9)

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Who sends to whom, sorted; who answers a ping, too."""
        return tuple(sorted({(source, to) for one in self.traffic for _, source, to in one.flow_ends}))

    @schema.model_validator(mode="after")
    def _names_are_known(self) -> "CosimScenario":
        for name, place in self._named():
            if name not in self.agents:
                hint = nearest(name, self.agents, f"agents: {', '.join(self.agents)}")
                raise schema.complaint(f"there is no agent {name!r}; {hint}", *place)
        return self

    def _named(self) -> Iterator[tuple[str, Location]]:
        """Yield every name of an agent, with the keys that lead to it."""
        if self.relay is not None:
            yield self.relay, ("relay",)
        for number, one in enumerate(self.traffic):
            yield one.source, ("traffic", number, "from")
            yield from ((name, ("traffic", number, "to")) for name in one.to)
        for number, fault in enumerate(self.faults):
            yield from ((name, ("faults", number, key)) for key, name in fault.agents)
        for agent, plan in self.agents.items():
            if isinstance(plan.motion, FollowPlan):
                yield from ((name, ("agents", agent, "motion", "leader")) for name in plan.motion.leader)

    @schema.model_validator(mode="after")
    def _relays(self) -> "CosimScenario":
        if self.topology is Topology.MASTER and self.relay is None:
            raise schema.complaint("a master relays, so that a relay: AGENT is needed", "topology")
        for number, one in enumerate(self.traffic):
            if one.transport == "ros1" and self.relay is None:
                raise schema.complaint(
                    "ros1 needs a master: name its host by relay: AGENT", "traffic", number, "protocol"
                )
        return self

    @schema.model_validator(mode="after")
    def _names_are_unique(self) -> "CosimScenario":
        found: set[str] = set()
        for number, one in enumerate(self.traffic):
            if one.title in found:
                raise schema.complaint(
                    f"two entries of the traffic are called {one.title!r}; give one another name", "traffic", number
                )
            found.add(one.title)
        return self

    @schema.model_validator(mode="after")
    def _seeds_are_different(self) -> "CosimScenario":
        if len(set(self.seeds)) < len(self.seeds):
            raise schema.complaint("a seed is named twice, and would give the same run", "seeds")
        return self

    @schema.model_validator(mode="after")
    def _a_clock_is_wrong_once(self) -> "CosimScenario":
        found: set[str] = set()
        for number, fault in enumerate(self.faults):
            if isinstance(fault, ClockSkewFault):
                if fault.agent in found:
                    raise schema.complaint(f"the clock of {fault.agent} is wrong twice", "faults", number, "agent")
                found.add(fault.agent)
        return self

    @schema.model_validator(mode="after")
    def _jammers_are_heard(self) -> "CosimScenario":
        for number, fault in enumerate(self.faults):
            if self.radio.fixed and isinstance(fault, JammerFault):
                raise schema.complaint(
                    "fixed links hear no jammer; leave it out, or loss, delay, rate and jitter of the radio",
                    "faults",
                    number,
                )
        return self

    @schema.model_validator(mode="after")
    def _followers_hear_their_leaders(self) -> "CosimScenario":
        heard = {(one.source, to) for one in self.traffic if isinstance(one, StreamTraffic) for to in one.to}
        for agent, plan in self.agents.items():
            for leader in plan.motion.leader if isinstance(plan.motion, FollowPlan) else ():
                if (leader, agent) not in heard:
                    raise schema.complaint(
                        f"{agent} follows {leader} and hears nothing of it; add to the traffic "
                        f"{{kind: stream, from: {leader}, to: {agent}, rate: 10Hz}}",
                        "agents",
                        agent,
                        "motion",
                    )
        return self

    @schema.model_validator(mode="after")
    def _windows_are_steps(self) -> "CosimScenario":
        if self.policy.window < self.physics.step:
            raise schema.complaint(
                f"a window of {self.policy.window:.12g} s is shorter than the physics' own step of "
                f"{self.physics.step:.12g} s, so that nothing changes in it",
                "policy",
                "window",
            )
        return self
