"""The schema of the faults in a scenario file."""

from typing import Annotated, Literal

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Length, Strict
from sim_backends.cosim.scenario.agent_plans import Name
from sim_backends.world.obstacles import Place, Real


class _Fault(Strict):
    """Base class of all faults.

    Attributes:
        from: Time when it begins.
    """

    begin: Annotated[Duration, Field(alias="from")] = 0.0

    @property
    def begin_ns(self) -> int:
        """Time when it begins, in nanoseconds."""
        return round(self.begin * 1e9)

    @property
    def agents(self) -> tuple[tuple[str, str], ...]:
        """The agents that the fault names, each as a pair of key and agent."""
        return ()


class _TimedFault(_Fault):
    """Base class of faults that have an end.

    Attributes:
        to: Time when it ends; if omitted, it lasts until the end of the run.
    """

    end: Annotated[Duration | None, Field(alias="to")] = None

    @schema.model_validator(mode="after")
    def _ends_after_begin(self) -> "_TimedFault":
        if self.end is not None and self.end <= self.begin:
            raise schema.validation_error(
                f"the end at {self.end:g} s is not after the beginning at {self.begin:g} s", "to"
            )
        return self

    @property
    def end_ns(self) -> int | None:
        """Time when it ends, in nanoseconds; None for never."""
        return None if self.end is None else round(self.end * 1e9)


class NodeLossFault(_TimedFault):
    """An agent's computer is off: its programs and its radio send nothing, and its body is commanded to stop.

    Attributes:
        kind: `node-loss`.
        agent: The agent.
    """

    kind: Literal["node-loss"]
    agent: Name

    @property
    @override
    def agents(self) -> tuple[tuple[str, str], ...]:
        return (("agent", self.agent),)


class LinkCutFault(_TimedFault):
    """Two agents receive nothing from each other.

    Attributes:
        kind: `link-cut`.
        between: The two agents.
    """

    kind: Literal["link-cut"]
    between: tuple[Name, Name]

    @schema.model_validator(mode="after")
    def _two_agents(self) -> "LinkCutFault":
        if self.between[0] == self.between[1]:
            raise schema.validation_error(f"{self.between[0]} has no link to itself", "between")
        return self

    @property
    @override
    def agents(self) -> tuple[tuple[str, str], ...]:
        return tuple(("between", name) for name in self.between)


class JammerFault(_TimedFault):
    """Continuous noise in the whole channel.

    Attributes:
        kind: `jammer`.
        power_dbm: Transmit power of the noise.
        at_m: Position of the jammer, metres east and north.
        height: Height of the jammer above the ground.
        agent: Instead of `at_m`: the agent that carries the jammer.
    """

    kind: Literal["jammer"]
    power_dbm: Annotated[Real, Field(ge=-100, le=80)]
    at_m: Place | None = None
    height: Length = 1.0
    agent: Name | None = None

    @schema.model_validator(mode="after")
    def _one_position(self) -> "JammerFault":
        if (self.at_m is None) == (self.agent is None):
            raise schema.validation_error(
                "a jammer needs either at_m: [EAST, NORTH], or an agent: NAME that carries it"
            )
        return self

    @property
    @override
    def agents(self) -> tuple[tuple[str, str], ...]:
        return () if self.agent is None else (("agent", self.agent),)


class ClockSkewFault(_TimedFault):
    """The clock of an agent, which its programs use for timers and time stamps, is wrong until the fault ends.

    Attributes:
        kind: `clock-skew`.
        agent: The agent.
        offset_ms: Offset of the clock at the beginning of the fault, in milliseconds; positive if it is ahead.
        rate_ppm: Rate error of the clock during the fault, in microseconds per second; positive if it is fast.
    """

    kind: Literal["clock-skew"]
    agent: Name
    offset_ms: Annotated[Real, Field(ge=-1e9, le=1e9)] = 0
    rate_ppm: Annotated[Real, Field(ge=-500_000, le=500_000)] = 0

    @property
    @override
    def agents(self) -> tuple[tuple[str, str], ...]:
        return (("agent", self.agent),)


class StalledFederateFault(_Fault):
    """Physics or network answers one request late, in wall time.

    Attributes:
        kind: `stalled-federate`.
        from: Simulated time; the first request for this time or a later time is delayed.
        federate: `physics` or `network`.
        stall: Delay in wall time; if it exceeds the deadline of a run, the run fails with an error that names the
            federate.
    """

    kind: Literal["stalled-federate"]
    federate: Literal["physics", "network"]
    stall: Annotated[Duration, Field(gt=0)] = 60.0


Fault = Annotated[
    NodeLossFault | LinkCutFault | JammerFault | ClockSkewFault | StalledFederateFault, Field(discriminator="kind")
]
"""A fault."""
