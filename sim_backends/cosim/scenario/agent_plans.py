"""The schema of the motions and the traffic of agents in a scenario file."""

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import (
    BeforeValidator,
    Bool,
    Duration,
    Field,
    Hertz,
    Int,
    Length,
    Speed,
    Strict,
)
from fieldkit.config.site import RobotName
from sim_backends.cosim.programs.senders import REPLY
from sim_backends.world.obstacles import Coordinate, Real

Name = RobotName
"""The name of an agent, or of an entry of the traffic."""


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


AgentNames = Annotated[
    tuple[Name, ...],
    Field(min_length=1, json_schema_extra={"type": ["string", "array"]}),
    BeforeValidator(_as_list),
]
"""One agent, or a list of several."""


Point = Annotated[tuple[Coordinate, ...], Field(min_length=2, max_length=3)]
"""Metres east and north, and up for agents that fly; without `up`, the agent keeps its initial height."""


class StandingPlan(Strict):
    """The agent gets no command, so it stays at its start position.

    Attributes:
        kind: `standing`.
    """

    kind: Literal["standing"] = "standing"


class WayPointsPlan(Strict):
    """The agent moves from point to point, and stays at the last point.

    Attributes:
        kind: `way-points`.
        points_m: The points after its start: metres east and north, and up for agents that fly.
        speed: Its speed.
        relative: True if the points are relative to its start.
        wait: Time that it stays at its start before it moves.
    """

    kind: Literal["way-points"]
    points_m: Annotated[tuple[Point, ...], Field(min_length=1)]
    speed: Annotated[Speed, Field(gt=0)]
    relative: Bool = False
    wait: Duration = 0.0


class LegPlan(Strict):
    """A part of a velocity profile.

    Attributes:
        duration: Its duration.
        speed: Speed of the agent: straight ahead if it drives, in the direction of its initial heading if it flies.
        turn_deg_s: Rate of turn to the left if it drives, in degrees per second.
        climb_m_s: Climb rate if it flies, in metres per second.
    """

    duration: Annotated[Duration, Field(gt=0)]
    speed: Speed = 0.0
    turn_deg_s: Real = 0
    climb_m_s: Real = 0


class VelocityProfilePlan(Strict):
    """The agent moves with a sequence of velocities, and then stops.

    Attributes:
        kind: `velocity-profile`.
        legs: The velocities, each with its duration.
    """

    kind: Literal["velocity-profile"]
    legs: Annotated[tuple[LegPlan, ...], Field(min_length=1)]


class FollowPlan(Strict):
    """The agent follows other agents, using only the states that it receives from them over the network.

    An agent that drives stays behind one leader at a distance that grows with its speed; an agent that flies stays
    above the centre of one or several leaders. Traffic of the kind `stream` must carry their states to the agent.

    Attributes:
        kind: `follow`.
        leader: The agent that it follows or, if it flies, a list of several agents.
        distance: Distance behind the leader at standstill or, if the agent flies, height above the leaders; from
            antenna to antenna.
        headway: Time headway behind the leader, in addition to the distance.
        timeout: Time without a state after which it stops.
    """

    kind: Literal["follow"]
    leader: AgentNames
    distance: Annotated[Length, Field(gt=0)]
    headway: Annotated[Duration, Field(gt=0)] = 1.0
    timeout: Annotated[Duration, Field(gt=0)] = 1.0


class StationKeepingPlan(Strict):
    """A flying agent stays at its start position.

    Attributes:
        kind: `station-keeping`.
    """

    kind: Literal["station-keeping"]


MotionPlan = Annotated[
    StandingPlan | WayPointsPlan | VelocityProfilePlan | FollowPlan | StationKeepingPlan, Field(discriminator="kind")
]
"""A motion of an agent."""


Protocol = Literal["udp", "tcp", "topic", "ros1", "ros1-udp"]

_MAX_BYTES = 65_000
"""Largest packet: UDP carries 65,507 bytes (RFC 768, RFC 791), which include the header of a topic."""

_MAX_MESSAGES = 10**6
"""Largest bag: it is in memory as a whole, 100 bytes per message, even if only a part of it is played."""

Bytes = Annotated[Int, Field(gt=0, le=_MAX_BYTES)]


class QosOptions(Strict):
    """The quality of service of a topic, with the names and defaults of ROS 2.

    Attributes:
        reliability: `reliable`, which retransmits lost samples, or `best_effort`.
        history: `keep_last` samples up to `depth`, or `keep_all`, which makes the writer wait for readers.
        depth: Number of samples that `keep_last` stores.
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
        qos: Quality of service of a topic; the defaults of ROS 2 if omitted.
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
    def _qos_and_ends_are_valid(self) -> "_Traffic":
        if self.qos is not None and self.protocol != "topic":
            raise schema.validation_error(
                f"only the protocol topic has a qos, but the protocol is {self.protocol}", "qos"
            )
        if self.source in self.to:
            raise schema.validation_error(f"{self.source} is both the sender and a receiver", "to")
        if len(set(self.to)) < len(self.to):
            raise schema.validation_error("an agent is listed twice", "to")
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
        """Name, source and destination of every flow, including the flows of replies."""
        return tuple((flow, self.source, to) for flow, to in self.flows.items())

    @property
    @abstractmethod
    def period_s(self) -> float:
        """Time between packets; 0 if it is not periodic."""

    @abstractmethod
    def packets(self, duration_s: float) -> float:
        """Return the approximate maximum number of packets that it sends in a scenario of this duration."""


class StreamTraffic(_Traffic):
    """An agent sends its state at a constant rate, for followers or to load the network.

    Attributes:
        kind: `stream`.
        rate: Packets per second.
        size_bytes: Size of each packet, without the headers of the transport.
        stop: Time from which nothing is sent; if omitted, it sends until the end.
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
    """A recorded bag is played back, each message at its recorded time.

    The defaults are those of the [paper](index.md#how-to-cite): 10 s of accelerometer data. The size is the size of a
    serialized `sensor_msgs/Imu` with the frame `imu_link`: 24 bytes of header, 32 of orientation, 24 of angular
    velocity, 24 of acceleration, and a covariance of 72 bytes for each of these three quantities. The rate is that of
    the Husky's simulated IMU.

    Attributes:
        kind: `bag`.
        length: Length of the recording.
        rate: Messages per second.
        size_bytes: Size of each message.
        jitter: Largest random delay with which a message was recorded, for example because of load.
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
    """A file is sent as fast as possible, as netcat does.

    Attributes:
        kind: `file`.
        size_bytes: Size of the file.
        piece_bytes: Size of each write to the transport: netcat uses 8192 bytes.
        port: Destination port in captures; a free port if omitted.
    """

    kind: Literal["file"]
    size_bytes: Annotated[Int, Field(gt=0, le=10**9)]
    piece_bytes: Bytes = 8192
    port: Annotated[Int | None, Field(ge=1, le=65_535, exclude_if=schema.is_empty)] = None

    @property
    @override
    def period_s(self) -> float:
        return 0.0

    @override
    def packets(self, duration_s: float) -> float:
        return len(self.to) * -(-self.size_bytes // self.piece_bytes)  # rounded up


class PingTraffic(_Traffic):
    """Echo requests; the receiver replies to each of them, in the flow `NAME/RECEIVER/reply`.

    Attributes:
        kind: `ping`.
        count: Number of requests.
        interval: Time between requests.
        size_bytes: Size of a request and of its reply, without the header: ping reports 56 as 64 bytes, because the
            header of ICMP has 8 bytes, like the header of UDP.
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
        request_count = min(self.count, (duration_s - self.start) / self.interval)
        return 2 * len(self.to) * max(request_count, 0.0)


Traffic = Annotated[StreamTraffic | BagTraffic | FileTraffic | PingTraffic, Field(discriminator="kind")]
"""The traffic of an agent."""
