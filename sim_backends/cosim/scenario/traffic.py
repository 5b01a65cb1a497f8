"""Traffic in a scenario file."""

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Hertz, Int, Strict
from sim_backends.cosim.programs.pings import REPLY
from sim_backends.cosim.scenario.names import AgentNames, Name

Protocol = Literal["udp", "tcp", "topic", "ros1", "ros1-udp"]

_MOST_BYTES = 65_000
"""In one packet: UDP carries 65,507 bytes (RFC 768, RFC 791), and a topic's header stands in them."""

_MOST_MESSAGES = 10**6
"""In a bag: it is in memory as a whole, 100 bytes for each, however much of it is played."""

Bytes = Annotated[Int, Field(gt=0, le=_MOST_BYTES)]


class QosOptions(Strict):
    """What publisher and subscribers of a topic agree on, by ROS 2's names and with its defaults.

    Attributes:
        reliability: `reliable`, which sends again what is lost, or `best_effort`.
        history: `keep_last` samples up to `depth`, or `keep_all`, which makes the writer wait for readers.
        depth: How many samples `keep_last` keeps.
    """

    reliability: Literal["reliable", "best_effort"] = "reliable"
    history: Literal["keep_last", "keep_all"] = "keep_last"
    depth: Annotated[Int, Field(gt=0, le=100_000)] = 10


class _Traffic(Strict, ABC):
    """What all traffic says.

    Attributes:
        name: Of it; `FROM-KIND` if left out. What goes to each receiver is the flow `NAME/RECEIVER`.
        from: Who sends it.
        to: Who gets it, one agent or a list of several.
        protocol: What carries it: `udp`, `tcp`, `topic` (DDS's publish-subscribe, without a master), `ros1` (TCPROS)
            or `ros1-udp` (UDPROS).
        qos: Of a topic.
        start: When it begins. The first packet follows at a random time within one period (a file: within 100 ms),
            since nothing starts robots simultaneously.
    """

    kind: str
    name: Name | None = None
    source: Annotated[Name, Field(alias="from")]
    to: AgentNames
    protocol: Protocol = "udp"
    qos: QosOptions | None = None
    start: Duration = 0.0

    @schema.model_validator(mode="after")
    def _between_others(self) -> "_Traffic":
        if self.qos is not None and self.protocol != "topic":
            raise schema.complaint(f"only a topic has a qos, and this is {self.protocol}", "qos")
        if self.source in self.to:
            raise schema.complaint(f"{self.source} sends to itself", "to")
        if len(set(self.to)) < len(self.to):
            raise schema.complaint("an agent is named twice", "to")
        return self

    @property
    def transport(self) -> str:
        """Name of the transport that its packets go by."""
        return self.protocol.removesuffix("-udp")

    @property
    def title(self) -> str:
        """Its name, or the one that it has if it says none."""
        return self.name or f"{self.source}-{self.kind}"

    @property
    def flows(self) -> dict[str, str]:
        """Receiver of each of its flows, by the flow's name."""
        return {f"{self.title}/{receiver}": receiver for receiver in self.to}

    @property
    def flow_ends(self) -> tuple[tuple[str, str, str], ...]:
        """Name, source and destination of every flow, those of answers included."""
        return tuple((flow, self.source, to) for flow, to in self.flows.items())

    @property
    @abstractmethod
    def period_s(self) -> float:
        """From one packet to the next; 0 where there is none."""

    @abstractmethod
    def packets(self, duration_s: float) -> float:
        """Return about how many packets it sends at most in a scenario of a duration."""


class StreamTraffic(_Traffic):
    """An agent that sends its own state at a constant rate, for followers and for load.

    Attributes:
        kind: `stream`.
        rate: Packets per second.
        size_bytes: Of each packet, without the headers of what carries it.
        stop: From when on nothing is sent; left out, never.
    """

    kind: Literal["stream"]
    rate: Annotated[Hertz, Field(gt=0, le=1e5)]
    size_bytes: Bytes = 100
    stop: Duration | None = None

    @property
    @override
    def period_s(self) -> float:
        return 1 / self.rate

    @override
    def packets(self, duration_s: float) -> float:
        seconds = min(duration_s, duration_s if self.stop is None else self.stop) - self.start
        return len(self.to) * max(seconds, 0.0) * self.rate


class BagTraffic(_Traffic):
    """A recorded bag that is played back, each message at its own time.

    The defaults are the paper's: 10 s of accelerometer data. The size is that of a serialized `sensor_msgs/Imu` whose
    frame is `imu_link`: 24 bytes of header, 32 of orientation, 24 of angular velocity, 24 of acceleration, and 72 of
    covariance with each. The rate is that of the Husky's simulated IMU.

    Attributes:
        kind: `bag`.
        length: How long was recorded.
        rate: Messages per second.
        size_bytes: Of each message.
        jitter: Most that a message was recorded later than at its rate, as clocks and loads do; drawn for each.
    """

    kind: Literal["bag"]
    length: Annotated[Duration, Field(gt=0)] = 10.0
    rate: Annotated[Hertz, Field(gt=0, le=1e5)] = 50.0
    size_bytes: Bytes = 320
    jitter: Duration = 0.001

    @schema.model_validator(mode="after")
    def _is_no_larger_than_bags_are(self) -> "BagTraffic":
        if (messages := self.length * self.rate) > _MOST_MESSAGES:
            raise schema.complaint(
                f"a bag has at most {_MOST_MESSAGES:,} messages, and {self.length:g} s of {self.rate:g} Hz are "
                f"{messages:,.0f}",
                "length",
            )
        return self

    @property
    @override
    def period_s(self) -> float:
        return 1 / self.rate

    @override
    def packets(self, duration_s: float) -> float:
        seconds = min(self.length, duration_s - self.start)
        return len(self.to) * max(seconds, 0.0) * self.rate


class FileTraffic(_Traffic):
    """A file that is sent as fast as it goes, as netcat does.

    Attributes:
        kind: `file`.
        size_bytes: Of the file.
        piece_bytes: What the program hands over at a time: netcat reads 8192 bytes.
    """

    kind: Literal["file"]
    size_bytes: Annotated[Int, Field(gt=0, le=10**9)]
    piece_bytes: Bytes = 8192

    @property
    @override
    def period_s(self) -> float:
        return 0.0

    @override
    def packets(self, duration_s: float) -> float:
        return len(self.to) * -(-self.size_bytes // self.piece_bytes)


class PingTraffic(_Traffic):
    """Requests that are answered; the answers are the flow `NAME/RECEIVER/reply`.

    Attributes:
        kind: `ping`.
        count: How many requests.
        interval: From one to the next.
        size_bytes: Of a request, and of its answer: 56 are what ping calls 64 bytes, with a header of 8 as UDP's.
    """

    kind: Literal["ping"]
    count: Annotated[Int, Field(gt=0, le=10**7)] = 100
    interval: Annotated[Duration, Field(ge=1e-5)] = 1.0
    size_bytes: Bytes = 56

    @property
    @override
    def flow_ends(self) -> tuple[tuple[str, str, str], ...]:
        return *super().flow_ends, *((flow + REPLY, to, self.source) for flow, to in self.flows.items())

    @property
    @override
    def period_s(self) -> float:
        return self.interval

    @override
    def packets(self, duration_s: float) -> float:
        sent = min(self.count, (duration_s - self.start) / self.interval)
        return 2 * len(self.to) * max(sent, 0.0)


Traffic = Annotated[StreamTraffic | BagTraffic | FileTraffic | PingTraffic, Field(discriminator="kind")]
"""What an agent sends."""
