"""The traffic in a scenario file."""

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Hertz, Int, Strict
from sim_backends.cosim.programs.pings import REPLY
from sim_backends.cosim.scenario.names import AgentNames, Name

Protocol = Literal["udp", "tcp", "topic", "ros1", "ros1-udp"]

_MAX_BYTES = 65_000
"""Largest packet: UDP carries 65,507 bytes (RFC 768, RFC 791), which must also hold the header of a topic."""

_MAX_MESSAGES = 10**6
"""Largest bag: it is in memory as a whole, 100 bytes per message, even if only a part of it is played."""

Bytes = Annotated[Int, Field(gt=0, le=_MAX_BYTES)]


class QosOptions(Strict):
    """The quality of service of a topic, with the names and defaults of ROS 2.

    Attributes:
        reliability: `reliable`, which retransmits lost samples, or `best_effort`.
        history: `keep_last` samples up to `depth`, or `keep_all`, which makes the writer wait for readers.
        depth: Number of samples that `keep_last` keeps.
    """

    reliability: Literal["reliable", "best_effort"] = "reliable"
    history: Literal["keep_last", "keep_all"] = "keep_last"
    depth: Annotated[Int, Field(gt=0, le=100_000)] = 10


class _Traffic(Strict, ABC):
    """Base class of all traffic.

    Attributes:
        name: Its name; `FROM-KIND` if omitted. The packets to each receiver are the flow `NAME/RECEIVER`.
        from: The sending agent.
        to: The receiving agent, or a list of several.
        protocol: Transport: `udp`, `tcp`, `topic` (DDS's publish-subscribe, without a master), `ros1` (TCPROS) or
            `ros1-udp` (UDPROS).
        qos: Quality of service of a topic.
        start: Time when it begins. The first packet is sent at a random time within one period after it (a file:
            within 100 ms), because robots do not start at the same time.
    """

    kind: str
    name: Name | None = None
    source: Annotated[Name, Field(alias="from")]
    to: AgentNames
    protocol: Protocol = "udp"
    qos: QosOptions | None = None
    start: Duration = 0.0

    @schema.model_validator(mode="after")
    def _ends_are_different(self) -> "_Traffic":
        if self.qos is not None and self.protocol != "topic":
            raise schema.validation_error(f"only a topic has a qos, and the protocol is {self.protocol}", "qos")
        if self.source in self.to:
            raise schema.validation_error(f"{self.source} sends to itself", "to")
        if len(set(self.to)) < len(self.to):
            raise schema.validation_error("an agent is named twice", "to")
        return self

    @property
    def transport(self) -> str:
        """Name of the transport of its packets."""
        return self.protocol.removesuffix("-udp")

    @property
    def title(self) -> str:
        """Its name, or the default name."""
        return self.name or f"{self.source}-{self.kind}"

    @property
    def flows(self) -> dict[str, str]:
        """The receiver of each of its flows, by the flow's name."""
        return {f"{self.title}/{receiver}": receiver for receiver in self.to}

    @property
    def flow_ends(self) -> tuple[tuple[str, str, str], ...]:
        """Name, source and destination of every flow, including those of replies."""
        return tuple((flow, self.source, to) for flow, to in self.flows.items())

    @property
    @abstractmethod
    def period_s(self) -> float:
        """Time between packets; 0 if it is not periodic."""

    @abstractmethod
    def packets(self, duration_s: float) -> float:
        """Return the approximate maximum number of packets that it sends in a scenario of a duration."""


class StreamTraffic(_Traffic):
    """An agent sends its own state at a constant rate, for followers and for load.

    Attributes:
        kind: `stream`.
        rate: Packets per second.
        size_bytes: Size of each packet, without the headers of the transport.
        stop: Time from which on nothing is sent; never if omitted.
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
    """A recorded bag is played back, each message at its own time.

    The defaults are the paper's: 10 s of accelerometer data. The size is that of a serialized `sensor_msgs/Imu` with
    the frame `imu_link`: 24 bytes of header, 32 of orientation, 24 of angular velocity, 24 of acceleration, and 72 of
    covariance with each. The rate is that of the Husky's simulated IMU.

    Attributes:
        kind: `bag`.
        length: Length of the recording.
        rate: Messages per second.
        size_bytes: Size of each message.
        jitter: Largest random delay of the recording of a message, as clocks and load cause it.
    """

    kind: Literal["bag"]
    length: Annotated[Duration, Field(gt=0)] = 10.0
    rate: Annotated[Hertz, Field(gt=0, le=1e5)] = 50.0
    size_bytes: Bytes = 320
    jitter: Duration = 0.001

    @schema.model_validator(mode="after")
    def _size_is_limited(self) -> "BagTraffic":
        if (messages := self.length * self.rate) > _MAX_MESSAGES:
            raise schema.validation_error(
                f"a bag has at most {_MAX_MESSAGES:,} messages, and {self.length:g} s of {self.rate:g} Hz are "
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
    """A file is sent as fast as possible, as by netcat.

    Attributes:
        kind: `file`.
        size_bytes: Size of the file.
        piece_bytes: Size of each write to the transport: netcat uses 8192 bytes.
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
    """Requests that are replied to; the replies are the flow `NAME/RECEIVER/reply`.

    Attributes:
        kind: `ping`.
        count: Number of requests.
        interval: Time between requests.
        size_bytes: Size of a request and of its reply, without the header: ping reports 56 as 64 bytes, because
            ICMP's header has 8 bytes, as UDP's.
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
"""The traffic of an agent."""
