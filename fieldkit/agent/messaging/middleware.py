"""Common interface of middlewares: publish and subscribe to serialized samples.

Adapters: `dds` (CycloneDDS), `zenoh`, `ros1` (rospy), `ros2` (rclpy). Each is imported only when it is used.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any, Callable, Mapping, Protocol

Deliver = Callable[[bytes, int], None]
"""Callback for each received sample: its serialized data, and its time of arrival in nanoseconds since 1970 UTC."""

ADAPTERS = ("dds", "zenoh", "ros1", "ros2")


class MiddlewareError(Exception):
    """A middleware, a video pipeline or a connection to an autopilot cannot be used; the text is for the operator."""


@dataclass(frozen=True)
class Quality:
    """A quality of service in ROS 2's terms; `system_default` leaves a policy to the middleware.

    Attributes:
        reliability: `reliable` or `best_effort`.
        history: `keep_last` or `keep_all`.
        depth: Number of samples for `keep_last`; 0 leaves it to the middleware.
        durability: `volatile` or `transient_local`.
        deadline_ns: Maximum expected time between two samples; None for no deadline.
        lifespan_ns: Time after which a sample expires; None for no limit.
        late_reader_depth: Number of samples that a DDS writer with `transient_local` keeps for readers that it
            discovers later; 0 for the number of `history` and `depth`.
    """

    reliability: str = "reliable"
    history: str = "keep_last"
    depth: int = 10
    durability: str = "volatile"
    deadline_ns: int | None = None
    lifespan_ns: int | None = None
    late_reader_depth: int = 0


@dataclass(frozen=True)
class Topic:
    """A topic with its names and types for all middlewares.

    Attributes:
        name: ROS name, for example `/scan`.
        type: ROS type, for example `sensor_msgs/msg/LaserScan`.
        quality: Its quality of service.
        members: Members of its type, which is the first key, and of all nested types. Each member has its name, its
            type, and a count: None for a single value, 0 for an unbounded sequence, N for an array of N
            values, or -N for a sequence of at most N values.
        dds_topic: DDS topic name, for example `rt/scan`.
        dds_types: DDS type name of each type in `members`.
        user_data: User data of DDS endpoints, which describe the type.
        key: Zenoh key expression.
        tokens: Zenoh key expressions of the liveliness tokens of a publisher of the topic, and of a subscription;
            `{zid}` is replaced by the id of the session.
        md5: MD5 sum of the ROS 1 type.
        definition: Definition of the ROS 1 type.
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
        """Return a topic from its decoded JSON object."""
        return cls(**{**data, "quality": Quality(**data.get("quality", {}))})


@dataclass(frozen=True)
class Network:
    """Network settings of a robot's middleware.

    Attributes:
        address: Its IPv4 address on the radio; no other address is used. For ROS 2, the environment selects it.
        discovery: `multicast`, `peers`, `router` or `master`; for ROS 2 also `environment`, the robot's settings.
        peers: Addresses of the other robots, for `peers`.
        server: Address of the router or master; for ROS 1, empty for the master in the robot's setup files.
        port: Port of the router or master, or of Zenoh's listener.
        domain: ROS domain.
        node: Name of the node.
        transport: `tcp` or `udp`, for Zenoh.
        gid_bytes: Length of a GID (the identifier of an endpoint) in the node information of DDS participants: 16
            since ROS 2 Iron, 24 before.
        settings: Settings of the middleware by their path: for example `Discovery/SPDPInterval` of CycloneDDS,
            `transport/link/tx/queue/size/data` of Zenoh; `xmlrpc_port`, `tcpros_port`, `tcp_nodelay` (`1` disables
            Nagle's algorithm) and `patience_s` (timeout for the master) of ROS 1. ROS 2 has no such settings, because
            its environment configures it.
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
    """A publisher of serialized samples."""

    def write(self, data: bytes) -> bool:
        """Send a sample; return True if the middleware accepted it."""

    def matched(self) -> int:
        """Return the number of matched subscriptions; for Zenoh, 1 if there is any."""

    def drain(self, limit_s: float) -> None:
        """Wait until all samples are acknowledged, at most for this time.

        Returns immediately if the middleware has no acknowledgements.
        """


class Middleware(Protocol):
    """A running middleware."""

    version: str

    def publisher(self, topic: Topic) -> Publisher:
        """Create a publisher of a topic."""

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        """Subscribe to a topic; samples of this middleware's publishers are not delivered.

        Args:
            topic: The topic.
            deliver: Called for each sample, in a background thread.

        Returns:
            A function that returns the number of matched publishers, or -1 for Zenoh.
        """

    def other_types(self, topic: Topic) -> set[str]:
        """Return the types that other participants announce for the topic, except its type in `topic`."""

    def close(self) -> None:
        """Close all endpoints and stop the middleware."""


def version_of(package: str) -> str:
    """Return the name and installed version of a package, or only its name if the version is unknown."""
    try:
        return f"{package} {metadata.version(package)}"
    except metadata.PackageNotFoundError:  # it is not installed as a package
        return package


def adapter(name: str) -> Callable[[Network], Middleware]:
    """Import a middleware, which may take seconds, and return the function that starts it.

    Args:
        name: One of `ADAPTERS`.

    Returns:
        A function that starts the middleware with network settings; it raises `MiddlewareError` if this fails.

    Raises:
        MiddlewareError: The middleware is unknown or not installed.
    """
    if name not in ADAPTERS:
        raise MiddlewareError(f"{name!r} is not a middleware; choose one of {', '.join(ADAPTERS)}")
    try:
        module = importlib.import_module(f"fieldkit.agent.messaging.{name}")
    except ImportError as error:
        raise MiddlewareError(f"{name} is not installed here: {error}") from error
    start: Callable[[Network], Middleware] = module.start
    return start
