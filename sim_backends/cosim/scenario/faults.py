"""Faults in a scenario file."""

from typing import Annotated, Literal

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Length, Strict
from sim_backends.cosim.scenario.names import Name
from sim_backends.world.obstacles import Place, Real


class _Fault(Strict):
    """What all faults say.

    Attributes:
        from: When it begins.
    """

    begin: Annotated[Duration, Field(alias="from")] = 0.0

    @property
    def begin_ns(self) -> int:
        """When it begins, in nanoseconds."""
        return round(self.begin * 1e9)

    @property
    def agents(self) -> tuple[tuple[str, str], ...]:
        """The agents that it is about, each after the key that names it."""
        return ()


class _Lasting(_Fault):
    """What faults say that last.

    Attributes:
        to: When it ends; left out, not before the run does.
    """

    end: Annotated[Duration | None, Field(alias="to")] = None

    @schema.model_validator(mode="after")
    def _ends_later(self) -> "_Lasting":
        if self.end is not None and self.end <= self.begin:
            raise schema.complaint(f"it ends at {self.end:g} s, not after it begins at {self.begin:g} s", "to")
        return self

    @property
    def end_ns(self) -> int | None:
        """When it ends, in nanoseconds; None for never."""
        return None if self.end is None else round(self.end * 1e9)


class NodeLossFault(_Lasting):
    """An agent's computer is off: its programs and its radio are silent, and its body is told to stop.

    Attributes:
        kind: `node-loss`.
        agent: Whose.
    """

    kind: Literal["node-loss"]
    agent: Name

    @property
    @override
    def agents(self) -> tuple[tuple[str, str], ...]:
        return (("agent", self.agent),)


class LinkCutFault(_Lasting):
    """Two agents do not hear each other.

    Attributes:
        kind: `link-cut`.
        between: Which two.
    """

    kind: Literal["link-cut"]
    between: tuple[Name, Name]

    @schema.model_validator(mode="after")
    def _two_agents(self) -> "LinkCutFault":
        if self.between[0] == self.between[1]:
            raise schema.complaint(f"{self.between[0]} has no link to itself", "between")
        return self

    @property
    @override
    def agents(self) -> tuple[tuple[str, str], ...]:
        return tuple(("between", name) for name in self.between)


class JammerFault(_Lasting):
    """Noise in the whole channel, without a pause.

    Attributes:
        kind: `jammer`.
        power_dbm: Power that it is sent with.
        at_m: From where, metres east and north.
        height: How high over the ground that is.
        agent: Instead of `at_m`: the agent that carries the jammer.
    """

    kind: Literal["jammer"]
    power_dbm: Annotated[Real, Field(ge=-100, le=80)]
    at_m: Place | None = None
    height: Length = 1.0
    agent: Name | None = None

    @schema.model_validator(mode="after")
    def _one_place(self) -> "JammerFault":
        if (self.at_m is None) == (self.agent is None):
            raise schema.complaint("a jammer stands either at_m: [EAST, NORTH], or is carried by an agent: NAME")
        return self

    @property
    @override
    def agents(self) -> tuple[tuple[str, str], ...]:
        return () if self.agent is None else (("agent", self.agent),)


class ClockSkewFault(_Lasting):
    """An agent's clock, by which its programs wake and stamp, is wrong; at the fault's end it is set right.

    Attributes:
        kind: `clock-skew`.
        agent: Whose.
        offset_ms: By how much it is fast from the fault's beginning on, in milliseconds; below 0 it is slow.
        rate_ppm: By how much more it goes fast, in microseconds per second.
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
    """Physics or network does not answer for a while in wall time, once, when it is asked about `from` or later.

    Attributes:
        kind: `stalled-federate`.
        federate: Which: `physics` or `network`.
        stall: For how long, in wall time; longer than a run's deadline, and the run ends by naming who stalls.
    """

    kind: Literal["stalled-federate"]
    federate: Literal["physics", "network"]
    stall: Annotated[Duration, Field(gt=0)] = 60.0


Fault = Annotated[
    NodeLossFault | LinkCutFault | JammerFault | ClockSkewFault | StalledFederateFault, Field(discriminator="kind")
]
"""What goes wrong."""
