"""Traffic in a scenario file."""

from typing import Annotated, Literal

from fieldkit.config.schema import BeforeValidator, Duration, Field, Hertz, Int, Strict

Protocol = Literal["udp", "tcp", "topic", "ros1"]
AgentName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,30}$")]


def _several(value: object) -> object:
    return [value] if isinstance(value, str) else value


AgentNames = Annotated[tuple[AgentName, ...], BeforeValidator(_several), Field(min_length=1)]
"""One agent, or several."""


class StreamTraffic(Strict):
    """An agent that sends its state at a constant rate.

    Attributes:
        kind: `stream`.
        name: Of the stream; `FROM-PROTOCOL` if left out. Each receiver's packets are the flow `NAME/RECEIVER`.
        from: Who sends it.
        to: Who gets it, one agent or several.
        protocol: What carries it: `udp`, `tcp`, `topic` (publish-subscribe without a master) or `ros1`.
        rate: Packets per second, in Hz.
        size_bytes: Of each packet, without the headers of what carries it.
        start: When the first is sent; left out, drawn within one period.
        stop: When nothing more is sent; left out, never.
    """

    kind: Literal["stream"]
    name: AgentName | None = None
    source: Annotated[AgentName, Field(alias="from")]
    to: AgentNames
    protocol: Protocol = "udp"
    rate: Annotated[Hertz, Field(gt=0, le=1e6)]
    size_bytes: Annotated[Int, Field(gt=0, le=65_000)] = 100
    start: Duration | None = None
    stop: Duration | None = None

    @property
    def flows(self) -> dict[str, str]:
        """Receiver of each of its flows, by the flow's name."""
        name = self.name or f"{self.source}-{self.protocol}"
        return {f"{name}/{receiver}": receiver for receiver in self.to}


Traffic = Annotated[StreamTraffic, Field()]
