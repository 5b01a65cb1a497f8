"""One face for middlewares: publish and subscribe to serialized samples.

Adapters: `dds` (CycloneDDS), `zenoh`, `ros1` (rospy), `ros2` (rclpy). Each is loaded only where it is asked for.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, Callable, Mapping, Protocol

Deliver = Callable[[bytes, int], None]
"""Told each sample that arrived, serialized, and when by this robot's clock, in nanoseconds since 1970 UTC."""

ADAPTERS = ("dds", "zenoh", "ros1", "ros2")


class MiddlewareError(Exception):
    """The middleware is missing, or refused what it was told."""


@dataclass(frozen=True)
class Quality:
    """A quality of service in ROS 2's words; `system_default` leaves a policy to the middleware.

    Attributes:
        reliability: `reliable` or `best_effort`.
        history: `keep_last` or `keep_all`.
        depth: How many, with `keep_last`; 0 leaves it to the middleware.
        durability: `volatile` or `transient_local`.
        deadline_ns: A sample is expected at least so often; None for never.
        lifespan_ns: A sample is worth nothing after this time; None for always.
    """

    reliability: str = "reliable"
    history: str = "keep_last"
    depth: int = 10
    durability: str = "volatile"
    deadline_ns: int | None = None
    lifespan_ns: int | None = None


@dataclass(frozen=True)
class Topic:
    """A topic by all the names that it has on the wire.

    Attributes:
        name: `/scan`.
        type: `sensor_msgs/msg/LaserScan`.
        quality: Its quality of service.
        members: Members of its type and of those that it is made of, by name, itself first: of each its name, type,
            and None for one, 0 for a sequence, the length of an array, or less than 0 for the bound of a sequence.
        dds_topic: `rt/scan`. For DDS, as are the next two.
        dds_types: DDS name of each type in `members`.
        user_data: What endpoints tell of the type.
        key: Key expression. For Zenoh, as is the next.
        tokens: Key expressions of the liveliness tokens of a publisher of the topic, and of a subscription;
            `{zid}` stands for the session.
        md5: Sum of the type. For ROS 1, as is the next.
        definition: Text of the type.
    """

    name: str
    type: str
    quality: Quality = field(default_factory=Quality)
    members: Mapping[str, Any] = field(default_factory=dict)
    dds_topic: str = ""
    dds_types: Mapping[str, str] = field(default_factory=dict)
    user_data: str = ""
    key: str = ""
    tokens: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    md5: str = ""
    definition: str = ""

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Topic:
        """Return a topic from what JSON made of it."""
        return cls(**{**data, "quality": Quality(**data.get("quality", {}))})


@dataclass(frozen=True)
class Network:
    """How a robot takes part.

    Attributes:
        address: Its IPv4 address on the radio; nothing goes over others, but of ROS 2, whose RMW is set by the
            robot's own environment.
        discovery: `multicast`, `peers`, `router` or `master`; of ROS 2 also `environment`, what that says.
        peers: Addresses of the other robots, for `peers`.
        server: Address of who runs the router or the master; of ROS 1, empty for what its setup files say.
        port: Port of that, or of Zenoh's own listener.
        domain: ROS domain.
        node: Name of the node.
        transport: `tcp` or `udp`, for Zenoh.
        gid_bytes: How long the name of an endpoint is in what DDS participants tell of their nodes: 16 since ROS 2
            Iron, 24 before.
        settings: The middleware's own settings by their path: `Discovery/SPDPInterval` of CycloneDDS,
            `transport/link/tx/queue/size/data` of Zenoh,
            `xmlrpc_port`, `tcpros_port` and `tcp_nodelay` (`1`: do not gather small messages) of ROS 1. Of ROS 2
            none: its environment has them.
    """

    address: str
    discovery: str = "multicast"
    peers: tuple[str, ...] = ()
    server: str = ""
    port: int = 0
    domain: int = 0
    node: str = "fieldkit"
    transport: str = "tcp"
    gid_bytes: int = 16
    settings: Mapping[str, str] = field(default_factory=dict)


class Publisher(Protocol):
    """What samples of a topic are written to."""

    def write(self, data: bytes) -> bool:
        """Send a sample; return whether the middleware took it."""

    def matched(self) -> int:
        """Return how many subscriptions are known; of Zenoh, 1 for any number."""

    def drain(self, limit_s: float) -> None:
        """Wait until what was sent is acknowledged, where it is, but no longer than this."""


class Middleware(Protocol):
    """A middleware that runs."""

    version: str

    def publisher(self, topic: Topic) -> Publisher:
        """Begin to publish a topic."""

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """Begin to subscribe to a topic; what its own publishers send is not delivered.

        Args:
            topic: Which.
            deliver: Called in a thread of its own for each sample.

        Returns:
            What tells how many publishers are known; of Zenoh, -1.
        """

    def other_types(self, topic: Topic) -> set[str]:
        """Return the types, other than the topic's own, that others have under its name, as they are spelt there."""

    def close(self) -> None:
        """End all of it."""


def version_of(package: str) -> str:
    """Return a package's name and version, as its installer noted it."""
    try:
        return f"{package} {metadata.version(package)}"
    except metadata.PackageNotFoundError:  # built by hand
        return package


def adapter(over: str) -> Callable[[Network], Middleware]:
    """Load a middleware, which takes a while, and return what starts it.

    Args:
        over: One of `ADAPTERS`.

    Returns:
        Told how this robot takes part; raises `MiddlewareError` where it does not start.

    Raises:
        MiddlewareError: It is not installed here.
    """
    if over not in ADAPTERS:
        raise MiddlewareError(f"there is no middleware {over!r}; there are {', '.join(ADAPTERS)}")
    try:
        found = importlib.import_module(f"fieldkit.agent.{over}")
    except ImportError as error:
        raise MiddlewareError(f"{over} is not installed here: {error}") from error
    start: Callable[[Network], Middleware] = found.start
    return start
