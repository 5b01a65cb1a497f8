"""What a scenario file may say."""

from typing import Annotated

from fieldkit.config import schema
from fieldkit.config.catalog import Named
from fieldkit.config.schema import AfterValidator, Duration, Field, Int, Length, Strict
from fieldkit.core.errors import nearest
from fieldkit.core.model import Scenario as Sight
from fieldkit.core.model import Topology
from sim_backends.cosim.scenario.motions import MotionPlan, StandingPlan
from sim_backends.cosim.scenario.policies import POLICIES
from sim_backends.cosim.scenario.traffic import AgentName, Traffic
from sim_backends.radio.options import RadioOptions
from sim_backends.world.obstacles import Place, Real


def _known_policy(name: str) -> str:
    if name not in POLICIES:
        hint = nearest(name, POLICIES, f"policies: {', '.join(POLICIES)}")
        raise schema.complaint(f"there is no sync policy {name!r}; {hint}")
    return name


class PolicyChoice(Strict):
    """The sync policy of a scenario; parameters count for every policy that has them, in a shootout too.

    Attributes:
        name: Of the policy that a run takes if it is not told another.
        window: Length of a window, or the velocity-aware policies' w.
        longest: What no window of a policy of variable windows exceeds.
        bound: How far two agents may displace each other within a window, for `error_bounded`.
    """

    name: Annotated[str, AfterValidator(_known_policy)] = "error_bounded"
    window: Annotated[Duration, Field(gt=0)] = 0.001
    longest: Annotated[Duration, Field(gt=0)] = 0.1
    bound: Annotated[Length, Field(gt=0)] = 0.01

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters as policies name them, in SI units."""
        return {"window_s": self.window, "longest_s": self.longest, "bound_m": self.bound}


class PhysicsOptions(Strict):
    """The physics of a scenario.

    Attributes:
        step: Its own step.
    """

    step: Annotated[Duration, Field(ge=1e-9, le=1)] = 0.001

    @property
    def step_ns(self) -> int:
        """Its own step in nanoseconds."""
        return round(self.step * 1e9)


class AgentPlan(Strict):
    """An agent of a scenario.

    Attributes:
        at_m: Where it starts, metres east and north.
        along: Instead: how far along the world's line it starts.
        aside_m: How far to the left of that line.
        height: How high over the ground; left out, it stands on it.
        motion: What it does.
    """

    at_m: Place | None = None
    along: Length | None = None
    aside_m: Real = 0
    height: Length | None = None
    motion: MotionPlan = StandingPlan(kind="standing")

    @schema.model_validator(mode="after")
    def _one_start(self) -> "AgentPlan":
        if (self.at_m is None) == (self.along is None):
            raise schema.complaint("it starts either at_m: [EAST, NORTH], or along: 20m the world's line")
        return self


class CosimScenario(Named):
    """A scenario of the co-simulation.

    Attributes:
        name: The file's name without `.yaml`.
        summary: One line for people.
        world: What stands around the agents: a file of the lab's own folder `worlds/`, or one that ships.
        line: Which of the world's lines agents start along.
        duration: How long it lasts, in simulated time.
        seeds: Of the random draws; a single run takes the first.
        physics: The physics.
        radio: The radio.
        topology: `masterless`, or `master`: everything passes the relay.
        relay: Whose access point relays in `master`.
        policy: The sync policy.
        agents: The agents by name.
        traffic: What they send.
    """

    world: str
    line: Sight = Sight.LOS
    duration: Annotated[Duration, Field(gt=0)]
    seeds: Annotated[tuple[Int, ...], Field(min_length=1)] = (1,)
    physics: PhysicsOptions = PhysicsOptions()
    radio: RadioOptions = RadioOptions()
    topology: Topology = Topology.MASTERLESS
    relay: AgentName | None = None
    policy: PolicyChoice = PolicyChoice()
    agents: Annotated[dict[AgentName, AgentPlan], Field(min_length=1)]
    traffic: tuple[Traffic, ...] = ()

    @property
    def duration_ns(self) -> int:
        """How long it lasts, in nanoseconds of simulated time."""
        return round(self.duration * 1e9)

    @schema.model_validator(mode="after")
    def _traffic_is_between_agents(self) -> "CosimScenario":
        for number, one in enumerate(self.traffic):
            for key, name in (("from", one.source), *(("to", name) for name in one.to)):
                if name not in self.agents:
                    hint = nearest(name, self.agents, f"agents: {', '.join(self.agents)}")
                    raise schema.complaint(f"there is no agent {name!r}; {hint}", "traffic", number, key)
        return self
