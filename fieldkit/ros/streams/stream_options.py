"""Streams of samples over a middleware: their YAML keys, and the arguments of the agents on the robots."""

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Final

from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.config.profiles import TopicName
from fieldkit.config.schema import AfterValidator, Bytes, Duration, Field, Hertz, Int, Strict
from fieldkit.core.model import Role
from fieldkit.ros.middlewares import ports, tuning
from fieldkit.ros.middlewares.middleware import (
    BINDINGS,
    DISCOVERY_METHODS,
    OVER_DDS,
    Discovery,
    MiddlewareName,
    invalid_setting_reason,
    judge_binding,
)
from fieldkit.ros.middlewares.ports import MiddlewarePorts
from fieldkit.ros.streams.read_options import ImageSize, Reads, dimensions
from fieldkit.steps import agent_commands
from fieldkit.steps.scene import Need, Scene

if TYPE_CHECKING:
    from fieldkit.ros.interfaces.qos import QosProfile

MESSAGE: Final = "std_msgs/msg/UInt8MultiArray"
IMAGE_MESSAGE: Final = "sensor_msgs/msg/Image"
MIN_BYTES: Final = 24
"""Size of the head of a sample: magic number, sequence number and time of sending."""
MAX_BYTES: Final = 16e6
_DEFAULT_BYTES: Final = 1000.0
LONGEST_S: Final = 3600.0


def _validate_profile(name: str) -> str:
    # `qos` and the message types take 50 ms to import, so only procedures with topics import them.
    from fieldkit.ros.interfaces.qos import PROFILES  # noqa: PLC0415

    if name not in PROFILES:
        raise schema.validation_error(f"ROS 2 has no profile {name!r}; there are {', '.join(PROFILES)}")
    return name


class StreamQos(Strict):
    """A quality of service: a profile of ROS 2, and values that override it.

    Attributes:
        profile: `default`, `sensor_data`, `services_default`, `parameters`, `parameter_events` or `system_default`,
            with ROS 2's values. The other keys override it.
        reliability: `reliable` or `best_effort`.
        history: `keep_last` or `keep_all`.
        depth: Number of samples that are kept with `keep_last`.
        durability: `volatile` or `transient_local`.
        deadline: Maximum expected time between two samples.
    """

    profile: Annotated[str, AfterValidator(_validate_profile)] = "default"
    reliability: Annotated[str, Field(pattern="^(reliable|best_effort)$")] | None = None
    history: Annotated[str, Field(pattern="^(keep_last|keep_all)$")] | None = None
    depth: Annotated[Int, Field(gt=0, le=100_000)] | None = None
    durability: Annotated[str, Field(pattern="^(volatile|transient_local)$")] | None = None
    deadline: Annotated[Duration, Field(gt=0)] | None = None

    def resolved(self) -> "QosProfile":
        """Return the profile with the values that override it."""
        from fieldkit.ros.interfaces.qos import PROFILES, Durability, History, QosProfile, Reliability  # noqa: PLC0415

        base = PROFILES[self.profile]
        return QosProfile(
            reliability=Reliability[self.reliability.upper()] if self.reliability else base.reliability,
            history=History[self.history.upper()] if self.history else base.history,
            depth=self.depth or base.depth,
            durability=Durability[self.durability.upper()] if self.durability else base.durability,
            deadline_ns=None if self.deadline is None else round(1e9 * self.deadline),
        )


Settings = dict[Annotated[str, Field(pattern=r"^[A-Za-z_]\w*(/[A-Za-z_]\w*)*(@[A-Za-z]+)?$")], str]


def _validate_settings(settings: Settings | str) -> Settings | str:
    if settings not in ("default", "tuned") and isinstance(settings, str):
        raise schema.validation_error(
            f"settings must be default, tuned, or a mapping of settings by path, not {settings!r}"
        )
    return settings


class StreamOptions(Strict):
    """A stream of samples from one robot to another.

    Attributes:
        sender: Role that publishes.
        receiver: Role that subscribes.
        over: `dds` (CycloneDDS), `zenoh`, `ros1`, or `ros2`: the robot's own ROS 2 with [its own
            RMW](topics.md#your-own-ros-2).
        topic: Name of the topic.
        rate: Samples per second.
        bytes: Size of a sample's data, 24 B to 16 MB.
        qos: Quality of service.
        discovery: `multicast` or `peers` for `dds`; `multicast`, `peers` or `router` for `zenoh`; `master` for
            `ros1`; `environment` (the robot's own), `multicast` or `peers` for `ros2`. The first of these is the
            default.
        server: Role that runs the router or the master.
        duration: Duration of the stream.
        patience: Maximum time for which the publisher waits for a subscription. If it discovers none, it sends
            nothing, which is a valid measurement.
        domain: ROS domain, 0 to 101; it must differ from the domains of other programs on the robots. Each domain has
            separate ports, also for Zenoh and ROS 1: simultaneous streams on one robot need different domains.
        transport: Transport of `zenoh`: `tcp` or `udp`.
        settings: `default`; `tuned`, for a lossy radio: [the tuned
            settings](studies/middleware.md#the-tuned-settings); or the middleware's own settings by their path:
            `Discovery/SPDPInterval: 500 ms` of CycloneDDS, `Internal/SocketReceiveBufferSize@min: 10 MB` for an
            attribute, `transport/link/tx/batch_size: "1400"` of Zenoh, `tcp_nodelay: "1"` of ROS 1, and for `ros2`
            environment variables: `RMW_IMPLEMENTATION: rmw_cyclonedds_cpp`.
        reads: Reads of the newest sample by a program of the receiver, which measure [the age of the
            sample](teleop.md).
        image: Size of grey images in pixels, such as `320x240`. The samples are then images of [a synthetic
            camera](teleop.md) (`sensor_msgs/Image`) instead of `bytes`.
    """

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    over: MiddlewareName = MiddlewareName.DDS
    topic: TopicName = "/fieldkit/stream"
    rate: Annotated[Hertz, Field(gt=0, le=100_000)] = 10.0
    bytes: Annotated[Bytes, Field(ge=MIN_BYTES, le=MAX_BYTES)] = _DEFAULT_BYTES
    qos: StreamQos = StreamQos.defaults()
    discovery: Discovery | None = None
    server: Role = Role.RELAY
    duration: Annotated[Duration, Field(gt=0, le=LONGEST_S)] = 10.0
    patience: Annotated[Duration, Field(gt=0, le=600)] = 20.0
    domain: Annotated[Int, Field(ge=0, le=ports.MAX_DOMAIN)] = 42
    transport: Annotated[str, Field(pattern="^(tcp|udp)$")] = "tcp"
    settings: Annotated[Settings | str, AfterValidator(_validate_settings)] = "default"
    reads: Reads | None = Field(default=None, exclude_if=schema.is_empty)
    image: ImageSize | None = Field(default=None, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _is_consistent(self) -> "StreamOptions":
        if self.sender == self.receiver:
            raise schema.validation_error(f"{self.sender} cannot send to itself; name another robot", "to")
        methods = DISCOVERY_METHODS[self.over]
        if self.discovery is not None and self.discovery not in methods:
            raise schema.validation_error(
                f"{self.over} cannot use {self.discovery}; use {' or '.join(methods)}", "discovery"
            )
        if self.transport != "tcp" and self.over is not MiddlewareName.ZENOH:
            raise schema.validation_error("only zenoh has a choice of transport; leave it out", "transport")
        if self.over is MiddlewareName.ROS1 and (self.qos.reliability or self.qos.profile) in {
            "best_effort",
            "sensor_data",
        }:
            raise schema.validation_error("ROS 1 sends by TCP, which is reliable; leave it out", "qos")
        if self.rate * self.duration < 1:
            raise schema.validation_error(
                "it ends before its second sample; write a longer duration or a higher rate", "duration"
            )
        if self.image is not None and self.bytes != _DEFAULT_BYTES:
            raise schema.validation_error("the size of an image is width x height; leave bytes out", "bytes")
        for name in self.middleware_settings if self.over is MiddlewareName.ROS2 else ():
            if reason := invalid_setting_reason(name):
                raise schema.validation_error(reason, "settings")
        return self

    @property
    def size_bytes(self) -> int:
        """Data bytes of a sample."""
        return math.prod(dimensions(self.image)) if self.image else round(self.bytes)

    @property
    def width(self) -> int:
        """Pixels per row of the images; 0 if the samples are not images."""
        return dimensions(self.image)[0] if self.image else 0

    @property
    def _message_type(self) -> str:
        """Type of the messages."""
        return IMAGE_MESSAGE if self.image else MESSAGE

    @property
    def discovery_method(self) -> Discovery:
        """The discovery method; the default one of the middleware if `discovery` is not set."""
        return self.discovery or DISCOVERY_METHODS[self.over][0]

    @property
    def server_role(self) -> Role | None:
        """Role of the robot that runs the router or the master; None without such a program."""
        return self.server if self.discovery_method in {Discovery.ROUTER, Discovery.MASTER} else None

    @property
    def participants(self) -> frozenset[Role]:
        """Roles of sender, receiver, and router or master."""
        return frozenset({self.sender, self.receiver} | ({self.server_role} if self.server_role else set()))

    @property
    def wire_ports(self) -> MiddlewarePorts:
        """Ports that identify its packets in a capture."""
        multicast = self.discovery_method in {Discovery.MULTICAST, Discovery.ENVIRONMENT}
        if self.over in OVER_DDS:
            return ports.dds(self.domain, multicast=multicast)
        return (
            ports.zenoh(self.domain, multicast=multicast)
            if self.over is MiddlewareName.ZENOH
            else ports.ros1(self.domain)
        )

    @property
    def listening_port(self) -> int:
        """Port of the router, of the master, or of Zenoh's listeners; 0 for `dds` and `ros2`: none is fixed."""
        if self.over in OVER_DDS:
            return 0
        return (
            ports.zenoh_listener(self.domain) if self.over is MiddlewareName.ZENOH else ports.ros1_master(self.domain)
        )

    @property
    def middleware_settings(self) -> Mapping[str, str]:
        """Settings of the middleware by their path."""
        if isinstance(self.settings, dict):
            return self.settings
        return tuning.recommended_settings(self.over, self.transport) if self.settings == "tuned" else {}

    def network(self, scene: Scene, role: Role) -> dict[str, Any]:
        """Return the fields of a `fieldkit.agent.messaging.middleware.Network` for a robot."""
        other = self.receiver if role == self.sender else self.sender
        node_ports = ports.ros1_node(self.domain) if self.over is MiddlewareName.ROS1 else {}
        settings = {**{name: str(port) for name, port in node_ports.items()}, **self.middleware_settings}
        return {
            "address": scene.robot(role).address,
            "discovery": self.discovery_method.value,
            "peers": [scene.robot(other).address] if self.discovery_method is Discovery.PEERS else [],
            "server": scene.robot(self.server_role).address if self.server_role else "",
            "port": self.listening_port,
            "domain": self.domain,
            "node": f"fieldkit_{role}",
            "transport": self.transport,
            "settings": {} if self.over is MiddlewareName.ROS2 else settings,
        }

    def environment(self, robot: Robot) -> dict[str, str]:
        """Return the agent's environment variables: for ROS 2, the robot's variables and the settings; else none."""
        return {**robot.ros_environment, **self.middleware_settings} if self.over is MiddlewareName.ROS2 else {}

    def need(self, role: Role, robot: Robot) -> Need:
        """Return the preflight check that a robot's Python has the middleware."""
        return need(role, robot, self.over, self.environment(robot))

    def agent_arguments(self, scene: Scene, role: Role) -> str:
        """Return the argument of the publishing or subscribing agent, as JSON."""
        from fieldkit.ros.interfaces import topics, types  # noqa: PLC0415

        network = self.network(scene, role)
        topic_description = topics.describe(
            types.standard_types(),
            self.topic,
            self._message_type,
            self.qos.resolved(),
            domain=self.domain,
            node=network["node"],
        )
        stream: dict[str, Any] = {
            "over": self.over.value,
            "size_bytes": self.size_bytes,
            "rate_hz": self.rate,
            "duration_s": self.duration,
            "patience_s": self.patience,
        }
        if self.reads:
            stream["reads_hz"] = self.reads.rate
        if self.image:
            stream["width"], stream["height"] = dimensions(self.image)
        return agent_commands.compact({"network": network, "topic": topic_description, "stream": stream})


def need(role: Role, robot: Robot, over: MiddlewareName, environment: Mapping[str, str] | None = None) -> Need:
    """Return the preflight check that a robot's Python has a middleware, run with these environment variables."""
    argv = agent_commands.python(robot, "-c", BINDINGS[over].load, environment=environment)
    return Need(
        role, f"{over} for Python", argv, partial(judge_binding, over), required_program=robot.profile.tools.python
    )
