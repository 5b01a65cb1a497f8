"""Robot profiles (`robots/*.yaml`) as frozen objects."""

import posixpath
import string
from typing import Annotated, Final

from fieldkit.config import catalog, schema
from fieldkit.config.schema import (
    AfterValidator,
    Bytes,
    Duration,
    Field,
    Fraction,
    Hertz,
    Int,
    Number,
    Strict,
    shaped,
)

RECORD_PLACEHOLDERS: Final = frozenset({"duration_s", "name", "topics"})

TopicName = Annotated[str, shaped(r"^(/[A-Za-z][A-Za-z0-9_]*)+$", "the name of a topic, as /scan or /camera/image")]


class PublishedTopic(Strict):
    """One ROS topic that the robot publishes.

    Attributes:
        name: For example `/scan`.
        type: ROS message type, `package/Name`.
        rate: Messages per second while the robot is up, in Hz.
        frame: `frame_id` of the header.
        child_frame: For odometry and for a transform, the frame of the robot that moves in `frame`.
        points: For a laser scan, beams per turn; for a point cloud, points of 16 bytes.
        width: For an image, in pixels of 3 bytes.
        height: As `width`.
        size: For any other type, bytes of the first list of numbers in each message.
        definition: What the type is made of, as `rosmsg show -r` prints it; needed where ROS itself has no such type.
    """

    name: TopicName
    type: Annotated[
        str, shaped(r"^[a-z][a-z0-9_]*/[A-Z][A-Za-z0-9]*$", "a type of messages, as sensor_msgs/LaserScan")
    ]
    rate: Hertz
    frame: str = ""
    child_frame: str = Field(default="", exclude_if=schema.is_empty)
    points: Annotated[Int, Field(gt=0, le=10_000_000)] | None = None
    width: Annotated[Int, Field(gt=0, le=100_000)] | None = Field(default=None, exclude_if=schema.is_empty)
    height: Annotated[Int, Field(gt=0, le=100_000)] | None = Field(default=None, exclude_if=schema.is_empty)
    size: Annotated[Bytes, Field(gt=0, le=50_000_000)] | None = Field(default=None, exclude_if=schema.is_empty)
    definition: str = Field(default="", exclude_if=schema.is_empty)

    @property
    def payload_bytes(self) -> int:
        """How large the list in each message is, in bytes, as far as the profile says it."""
        if self.type == "sensor_msgs/PointCloud2":
            return 16 * (self.points or 0)
        return round(self.size or 3 * (self.width or 0) * (self.height or 0))


def _known_placeholders(argv: tuple[str, ...]) -> tuple[str, ...]:
    for word in argv:
        for _, name, form, conversion in string.Formatter().parse(word):
            if name is not None and (name not in RECORD_PLACEHOLDERS or form or conversion):
                valid = ", ".join(f"{{{known}}}" for known in sorted(RECORD_PLACEHOLDERS))
                raise schema.complaint(f"{word!r} has an unknown placeholder; valid: {valid}")
    if "{topics}" not in argv:
        raise schema.complaint("the word {topics} is missing; it becomes one word per topic")
    return argv


def _whole_path(text: str) -> str:
    if not text.startswith("/") or posixpath.normpath(text) != text or "\0" in text:
        raise schema.complaint(f"{text!r} is no whole path of a file; no shell sees it: /opt/ros/noetic/setup.bash")
    return text


class RecordCommand(Strict):
    """How one ROS variant records topics.

    Attributes:
        distribution: ROS distribution, for example `noetic`.
        setup: Shell files to source first: a non-interactive SSH session skips `.bashrc`.
        record: Argument list; `{duration_s}`, `{name}` and `{topics}` are filled in.
        ends: `itself` after its duration, or on `sigint` (ros2 bag record has no duration).
        writes: The file that holds the messages, `{name}` filled in; for ROS 2 in a folder.
        rmw: The middleware of ROS 2 where the environment names none: `cyclonedds` (DDS) or `zenoh`.
    """

    distribution: str
    setup: tuple[Annotated[str, AfterValidator(_whole_path)], ...] = ()
    record: Annotated[tuple[str, ...], AfterValidator(_known_placeholders)]
    ends: Annotated[str, Field(pattern="^(itself|sigint)$")]
    writes: str
    rmw: Annotated[str, Field(pattern="^(cyclonedds|zenoh)$", exclude_if=lambda name: name == "cyclonedds")] = (
        "cyclonedds"
    )


_Crossing = Annotated[
    str,
    shaped(
        r"^(/[A-Za-z]\w*)+:[a-z]\w*/(msg/)?[A-Z]\w*(:[a-z0-9_=,]+)?$",
        "NAME:TYPE or NAME:TYPE:QOS, as /scan:sensor_msgs/LaserScan",
    ),
]


class RobotBridge(Strict):
    """Topics of a robot with ROS 1 that `fieldkit bridge`, running on it, carries to a middleware without a master.

    Attributes:
        to: `dds` or `zenoh`.
        topics: Carried there, each as a word of that command: `/scan:sensor_msgs/LaserScan:sensor_data`.
        back: Carried the other way.
        domain: ROS domain.
        router: Host, and port if it is another than usual, of a router of Zenoh; None scouts.
        program: The robot's fieldkit, a name or a path.
    """

    to: Annotated[str, Field(pattern="^(dds|zenoh)$")]
    topics: tuple[_Crossing, ...] = ()
    back: tuple[_Crossing, ...] = ()
    domain: Annotated[Int, Field(ge=0, le=101)] = 0
    router: Annotated[str, Field(pattern=r"^[\w.-]+(:\d{1,5})?$")] | None = None
    program: str = "fieldkit"

    @schema.model_validator(mode="after")
    def _carries_something(self) -> "RobotBridge":
        if not self.topics and not self.back:
            raise schema.complaint("it carries nothing; name topics", "topics")
        if self.router is not None and self.to != "zenoh":
            raise schema.complaint("a router is Zenoh's; write to: zenoh", "router")
        return self

    def command(self, address: str, master: str, patience_s: int) -> tuple[str, ...]:
        """Return the command that carries them.

        Args:
            address: Of the robot, where the others are.
            master: Address of its ROS master; empty where its setup files say which.
            patience_s: How long the master is awaited.
        """
        options = ["--from", "ros1", "--to", self.to, "--address", address, "--domain", str(self.domain)]
        options += ["--patience", str(patience_s)]
        options += ["--master", master] if master else []
        options += ["--router", self.router] if self.router else []
        back = (word for topic in self.back for word in ("--back", topic))
        return (self.program, "bridge", *options, *back, *self.topics)


MOST_DOMAIN: Final = 232
"""Above it there are no ports for RTPS (docs.ros.org, "The ROS_DOMAIN_ID")."""


class Ros(Strict):
    """The ROS side of a robot.

    Attributes:
        variant: Which of `variants` this model runs.
        variants: Record command per ROS generation, `ros1` or `ros2`.
        environment: Variables that the robot's shell would set.
        topics: What it publishes.
        bridge: What is carried to DDS or Zenoh; None for nothing.
    """

    variant: Annotated[str, Field(pattern="^(ros1|ros2)$")]
    variants: dict[Annotated[str, Field(pattern="^(ros1|ros2)$")], RecordCommand]
    environment: dict[str, str] = Field(default_factory=dict)
    topics: tuple[PublishedTopic, ...]
    bridge: RobotBridge | None = Field(default=None, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _variant_exists(self) -> "Ros":
        if self.variant not in self.variants:
            raise schema.complaint(f"variant {self.variant!r} has no entry under variants")
        if self.bridge is not None and self.variant != "ros1":
            raise schema.complaint("a robot with ROS 2 needs no bridge; leave it out", "bridge")
        return self

    @schema.model_validator(mode="after")
    def _is_in_a_domain(self) -> "Ros":
        text = self.environment.get("ROS_DOMAIN_ID") or "0"
        if not (text.isascii() and text.isdecimal() and int(text) <= MOST_DOMAIN):
            why = f"{text!r} is no domain of ROS 2; take a whole number from 0 to {MOST_DOMAIN}"
            raise schema.complaint(why, "environment", "ROS_DOMAIN_ID")
        return self

    @property
    def domain(self) -> int:
        """The domain of ROS 2 that its programs are in, as its environment says it; 0 is ROS 2's own."""
        return int(self.environment.get("ROS_DOMAIN_ID") or 0)

    @property
    def middleware(self) -> str:
        """What carries its ROS 2: `zenoh`, or `dds` by whichever RMW, as all of those speak RTPS."""
        named = self.environment.get("RMW_IMPLEMENTATION") or self.command.rmw
        return "zenoh" if named.removeprefix("rmw_").startswith("zenoh") else "dds"

    @property
    def command(self) -> RecordCommand:
        """The record command of the variant that the robot runs."""
        return self.variants[self.variant]


class Tools(Strict):
    """Programs that the robot offers under these names, and how it grants the right to capture.

    Attributes:
        netcat: Its netcat, a name or a path; which variant it is, is found out before each trial.
        capture: tcpdump.
        ping: Its ping.
        python: Its Python, for steps that bring a program of fieldkit's along.
        capture_right: `direct` (root or capabilities) or `sudo` (`sudo -n`, never a prompt).
    """

    netcat: str = "nc.traditional"
    capture: str = "tcpdump"
    ping: str = "ping"
    python: str = Field(default="python3", exclude_if=lambda name: name == "python3")
    capture_right: Annotated[str, Field(pattern="^(direct|sudo)$")] = "direct"


class Radio(Strict):
    """The robot's radio.

    Attributes:
        interface: Name of the network interface under test.
        standard: For example `802.11n 2.4 GHz`.
        access_point: Whether the robot runs its own access point.
        tx_power_dbm: Transmit power in dBm.
        sensitivity_dbm: Weakest signal it still receives, in dBm.
    """

    interface: Annotated[str, shaped(r"^[a-z][a-z0-9._-]{0,14}$", "the name of a network interface, as wlan0")]
    standard: str
    access_point: schema.Bool = False
    tx_power_dbm: Number | Int
    sensitivity_dbm: Number | Int


LEAST_CHARGE: Final = 0.2
"""Below which no drone begins a flight; 20 % is what makers of its batteries tell to leave in them."""

_CONNECTION: Final = r"^((udpout|udpin|tcp):[0-9A-Za-z.-]+:[0-9]{1,5}|/dev/[0-9A-Za-z/_.-]+:[0-9]{3,7})$"


class Mavlink(Strict):
    """The MAVLink endpoint of an autopilot.

    Attributes:
        port: UDP port at which others reach it over the radio.
        connection: How the robot itself reaches it: `udpout:HOST:PORT`, which speaks first, `udpin:HOST:PORT`,
            `tcp:HOST:PORT` or `/dev/ttyAMA0:921600`; None for that port.
        autopilot: As which an emulated one answers: `px4` or `ardupilot`. A real one says itself what it is.
        least_charge: What its battery must have, of 1, before a step flies it.
    """

    port: Annotated[Int, Field(gt=0, lt=65536)]
    connection: (
        Annotated[str, shaped(_CONNECTION, "a connection, as udpout:127.0.0.1:14550 or /dev/ttyAMA0:921600")] | None
    ) = None
    autopilot: Annotated[str, Field(pattern="^(px4|ardupilot)$", exclude_if=lambda name: name == "px4")] = "px4"
    least_charge: Annotated[Fraction, Field(exclude_if=lambda share: share == LEAST_CHARGE)] = LEAST_CHARGE

    @property
    def own(self) -> str:
        """How the robot itself reaches it."""
        return self.connection or f"udpout:127.0.0.1:{self.port}"


class Drive(Strict):
    """How a ground robot is driven: by velocities on a topic, `geometry_msgs/Twist`.

    Attributes:
        topic: That its base listens to.
        odometry: That says where it is, `nav_msgs/Odometry`.
        turn_rad_s: Most that it is turned, in radians per second.
        acceleration_m_s2: Most that its speed is made to grow per second, in m/s^2.
        lease: It stops where the laptop has been silent for so long.
    """

    topic: TopicName = "/cmd_vel"
    odometry: TopicName = "/odom"
    turn_rad_s: Annotated[Number | Int, Field(gt=0, le=10)] = 1.0
    acceleration_m_s2: Annotated[Number | Int, Field(gt=0, le=10)] = 0.5
    lease: Annotated[Duration, Field(ge=0.5, le=30)] = 2.0


class Limits(Strict):
    """What the robot can do.

    Attributes:
        max_speed_m_s: Top speed in m/s.
        max_height_m: How high over where it took off a drone may fly, in metres; None for one that no step may fly.
        fence_m: How far from where it began it may go, over the ground, in metres; None for one that no step moves.
        battery_min: Rough running time on one charge, in minutes.
    """

    max_speed_m_s: Number | Int
    max_height_m: Annotated[Number | Int, Field(gt=0)] | None = Field(default=None, exclude_if=schema.is_empty)
    fence_m: Annotated[Number | Int, Field(gt=0)] | None = Field(default=None, exclude_if=schema.is_empty)
    battery_min: Number | Int | None = None


class RobotProfile(catalog.Named):
    """What a robot model is: one YAML file in `robots/`.

    Attributes:
        kind: `ugv`, `uav` or `usv`: on the ground, in the air, on water.
        computer: The on-board computer.
        radio: Its radio.
        tools: Its programs.
        ros: Its ROS side; None for a robot without, on which no step records.
        limits: What it can do.
        mavlink: Its autopilot, if it has one.
        drive: How it is driven; None for one that a person moves.
    """

    kind: Annotated[str, Field(pattern="^(ugv|uav|usv)$")]
    computer: str
    radio: Radio
    tools: Tools = Tools.defaults()
    ros: Ros | None = None
    limits: Limits
    mavlink: Mavlink | None = None
    drive: Drive | None = Field(default=None, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _has_a_fence(self) -> "RobotProfile":
        if self.drive is not None and self.limits.fence_m is None:
            raise schema.complaint("a robot that is driven has a fence; write how far it may go: limits.fence_m")
        return self


def load_profile(name: str) -> RobotProfile:
    """Return the profile `name`, the lab's own folder first.

    Raises:
        ConfigurationError: No such profile (the nearest name is given), or an error in its file.
    """
    return catalog.load("robots", name, RobotProfile)
