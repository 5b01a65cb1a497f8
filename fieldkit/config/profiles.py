"""Robot profiles (`robots/*.yaml`) as frozen objects."""

import posixpath
import string
from collections.abc import Mapping
from typing import Annotated, ClassVar, Final

from fieldkit.config import catalog, schema
from fieldkit.config.antennas import AntennaOptions
from fieldkit.config.schema import AfterValidator, Bytes, Field, Hertz, Int, Number, Strict, pattern_field
from fieldkit.config.sections import Sectioned
from fieldkit.config.wifi_phy import WifiPhy, check_standard
from fieldkit.core import plugins

TELEMETRY: Final = "telemetry"
"""Key of the section that lists telemetry sources, which report the state of a radio without `iw`."""

RECORD_PLACEHOLDERS: Final = frozenset({"duration_s", "name", "topics"})

TopicName = Annotated[
    str, pattern_field(r"^(/[A-Za-z][A-Za-z0-9_]*)+$", "the name of a topic, such as /scan or /camera/image")
]


class PublishedTopic(Strict):
    """One ROS topic that the robot publishes.

    Attributes:
        name: Name, `/scan`.
        type: ROS message type, `package/Name`.
        rate: Messages per second, `5Hz`.
        frame: `frame_id` of the header.
        child_frame: For `nav_msgs/Odometry` and `tf2_msgs/TFMessage`, the frame of the robot, which moves in `frame`.
            Emulated robots use `base_link` if it is empty.
        points: For a laser scan, beams per turn; for a point cloud, number of points, each of 16 bytes.
        width: For an image, width in pixels of 3 bytes.
        height: For an image, height in pixels.
        size: For any other type, size of the first array of numbers in each message, `100kB`.
        definition: Message definition, as `rosmsg show -r` prints it; needed for types that ROS does not have.
    """

    name: TopicName
    type: Annotated[
        str, pattern_field(r"^[a-z][a-z0-9_]*/[A-Z][A-Za-z0-9]*$", "a message type, such as sensor_msgs/LaserScan")
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
        """Size of the data array in each message of a point cloud, an image or a type with `size`, in bytes.

        It is 0 for other types, for example for a laser scan.
        """
        if self.type == "sensor_msgs/PointCloud2":
            return 16 * (self.points or 0)
        return round(self.size or 3 * (self.width or 0) * (self.height or 0))


def _require_known_placeholders(argv: tuple[str, ...]) -> tuple[str, ...]:
    for word in argv:
        for _, name, form, conversion in string.Formatter().parse(word):
            if name is not None and (name not in RECORD_PLACEHOLDERS or form or conversion):
                valid = ", ".join(f"{{{placeholder}}}" for placeholder in sorted(RECORD_PLACEHOLDERS))
                raise schema.validation_error(f"{word!r} has an unknown placeholder; valid: {valid}")
    if "{topics}" not in argv:
        raise schema.validation_error("the word {topics} is missing; it becomes one word per topic")
    return argv


def _absolute_path(text: str) -> str:
    if not text.startswith("/") or posixpath.normpath(text) != text or "\0" in text:
        raise schema.validation_error(
            f"{text!r} is not an absolute path without . and .., such as "
            "/opt/ros/noetic/setup.bash; no shell expands it"
        )
    return text


class RecordCommand(Strict):
    """The record command of one ROS variant.

    Attributes:
        distribution: ROS distribution, for example `noetic`.
        setup: Shell files to source first: an SSH session without a terminal skips `.bashrc`.
        record: Argument list of the record command. `{duration_s}` and `{name}` are filled in; the word `{topics}`
            becomes one word per topic.
        ends: `itself`: the command exits after its duration. `sigint`: fieldkit stops it by SIGINT (`ros2 bag record`
            has no duration).
        writes: The file that contains the messages, with `{name}` filled in: `{name}.bag`, for ROS 2
            `{name}/{name}_0.db3` or `.mcap`.
        rmw: Middleware of ROS 2, `cyclonedds` (DDS) or `zenoh`, unless `RMW_IMPLEMENTATION` names one.
    """

    distribution: str
    setup: tuple[Annotated[str, AfterValidator(_absolute_path)], ...] = ()
    record: Annotated[tuple[str, ...], AfterValidator(_require_known_placeholders)]
    ends: Annotated[str, Field(pattern="^(itself|sigint)$")]
    writes: str
    rmw: Annotated[str, Field(pattern="^(cyclonedds|zenoh)$", exclude_if=lambda name: name == "cyclonedds")] = (
        "cyclonedds"
    )


_BridgedTopic = Annotated[
    str,
    pattern_field(
        r"^(/[A-Za-z]\w*)+:[a-z]\w*/(msg/)?[A-Z]\w*(:[a-z0-9_=,]+)?$",
        "NAME:TYPE or NAME:TYPE:QOS, such as /scan:sensor_msgs/LaserScan",
    ),
]


class RobotBridge(Strict):
    """Topics of a robot with ROS 1 that `fieldkit bridge` on this robot carries to a middleware without a master.

    Attributes:
        to: `dds` or `zenoh`.
        topics: Topics carried to this middleware, each `NAME:TYPE` or `NAME:TYPE:QOS`, as in `fieldkit bridge`.
        back: Topics carried from this middleware to ROS 1.
        domain: ROS 2 domain, 0 to 101.
        router: Host of a Zenoh router, and its port if it is not 7447; without it, peers are found by scouting.
        program: The robot's fieldkit, a name or a path.
    """

    to: Annotated[str, Field(pattern="^(dds|zenoh)$")]
    topics: tuple[_BridgedTopic, ...] = ()
    back: tuple[_BridgedTopic, ...] = ()
    domain: Annotated[Int, Field(ge=0, le=101)] = 0
    router: Annotated[str, Field(pattern=r"^[\w.-]+(:\d{1,5})?$")] | None = None
    program: str = "fieldkit"

    @schema.model_validator(mode="after")
    def _require_topics(self) -> "RobotBridge":
        if not self.topics and not self.back:
            raise schema.validation_error("it carries no topics; add topics or back", "topics")
        if self.router is not None and self.to != "zenoh":
            raise schema.validation_error("only Zenoh has a router; write to: zenoh", "router")
        return self

    def command(self, address: str, master: str, patience_s: int) -> tuple[str, ...]:
        """Return the command that carries the topics.

        Args:
            address: Address of the robot in the network of the other nodes.
            master: Address of its ROS master; empty if its setup files set it.
            patience_s: Time limit for the connection to the master.
        """
        options = ["--from", "ros1", "--to", self.to, "--address", address, "--domain", str(self.domain)]
        options += ["--patience", str(patience_s)]
        options += ["--master", master] if master else []
        options += ["--router", self.router] if self.router else []
        back = (word for topic in self.back for word in ("--back", topic))
        return (self.program, "bridge", *options, *back, *self.topics)


MAX_DOMAIN: Final = 232
"""Highest domain. Above it there are no ports for RTPS (docs.ros.org, "The ROS_DOMAIN_ID")."""


class Ros(Strict):
    """ROS settings of a robot.

    Attributes:
        variant: The entry of `ros.variants` that the robot runs: `ros1` or `ros2`.
        variants: Record command per ROS version, `ros1` or `ros2`.
        environment: Variables set for the record command and for the bridge. `ROS_DOMAIN_ID` (0 to 232) and
            `RMW_IMPLEMENTATION` also determine how the robot [is driven](motion.md) and which middleware an emulated
            robot uses.
        topics: Topics that the robot publishes; emulated robots publish them.
        bridge: Topics of a robot with ROS 1 that [a bridge](bridge.md#in-a-profile) on the robot carries.
    """

    variant: Annotated[str, Field(pattern="^(ros1|ros2)$")]
    variants: dict[Annotated[str, Field(pattern="^(ros1|ros2)$")], RecordCommand]
    environment: dict[str, str] = Field(default_factory=dict)
    topics: tuple[PublishedTopic, ...]
    bridge: RobotBridge | None = Field(default=None, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _require_variant(self) -> "Ros":
        if self.variant not in self.variants:
            raise schema.validation_error(f"variant {self.variant!r} has no entry under variants")
        if self.bridge is not None and self.variant != "ros1":
            raise schema.validation_error("a robot with ROS 2 needs no bridge; omit it", "bridge")
        return self

    @schema.model_validator(mode="after")
    def _require_valid_domain(self) -> "Ros":
        text = self.environment.get("ROS_DOMAIN_ID") or "0"
        if not (text.isascii() and text.isdecimal() and int(text) <= MAX_DOMAIN):
            message = f"{text!r} is not a domain of ROS 2; use a whole number from 0 to {MAX_DOMAIN}"
            raise schema.validation_error(message, "environment", "ROS_DOMAIN_ID")
        return self

    @property
    def domain(self) -> int:
        """The ROS 2 domain of its programs, from `environment`; the default of ROS 2 is 0."""
        return int(self.environment.get("ROS_DOMAIN_ID") or 0)

    @property
    def middleware(self) -> str:
        """Middleware of its ROS 2: `zenoh`, or `dds` for any other RMW, since all of these use RTPS."""
        rmw = self.environment.get("RMW_IMPLEMENTATION") or self.command.rmw
        return "zenoh" if rmw.removeprefix("rmw_").startswith("zenoh") else "dds"

    @property
    def command(self) -> RecordCommand:
        """The record command of the variant that the robot runs."""
        return self.variants[self.variant]


class Tools(Strict):
    """Names of programs on the robot, and the privileges of captures.

    Attributes:
        netcat: Its netcat: traditional, OpenBSD, ncat or busybox. The variant is
            [detected](method-loss.md#tools-that-differ) before each trial; a dry run derives it from the name and
            treats `nc` as traditional.
        capture: Its tcpdump.
        ping: Its ping: iputils (old or new) or busybox.
        python: Its Python, 3.8 or later, for the programs that fieldkit copies to it, for example in the step
            `topics`; searched after the setup files of ROS are sourced.
        capture_right: `direct`: the user has the right to capture. `sudo`: captures are started by `sudo -n` (never a
            prompt), see [the right to capture](field.md#the-right-to-capture).
    """

    netcat: str = "nc.traditional"
    capture: str = "tcpdump"
    ping: str = "ping"
    python: str = Field(default="python3", exclude_if=lambda name: name == "python3")
    capture_right: Annotated[str, Field(pattern="^(direct|sudo)$")] = "direct"


InterfaceName = Annotated[
    str, pattern_field(r"^[a-z][a-z0-9._-]{0,14}$", "the name of a network interface, such as wlan0")
]
LinkName = Annotated[
    str, pattern_field(r"^[a-z][a-z0-9-]{0,15}$", "a name of at most 16 lower-case letters, digits and -")
]


class Radio(Strict):
    """The robot's radio.

    Attributes:
        interface: Name of the network interface under test, `wlan0`.
        standard: For example `802.11n 2.4 GHz`.
        access_point: True if the robot runs an access point; `check` reports if its radio is a station.
        tx_power_dbm: Transmit power in dBm; used by the emulated radio.
        sensitivity_dbm: Weakest signal that it can receive, in dBm; used by the emulated radio, and by `check` to
            report a weak signal.
        phy: Physical layer of 802.11n, ac or ax, for the emulated radio.
        antenna: Pattern and orientation of its antenna, for the emulated radio.
    """

    interface: InterfaceName
    standard: str
    access_point: schema.Bool = False
    tx_power_dbm: Number | Int
    sensitivity_dbm: Number | Int
    phy: WifiPhy | None = Field(default=None, exclude_if=schema.is_empty)
    antenna: AntennaOptions | None = Field(default=None, exclude_if=schema.is_empty)

    @schema.model_validator(mode="after")
    def _check_standard(self) -> "Radio":
        check_standard(self.standard, self.phy)
        return self


class Limits(Strict):
    """Limits of the robot.

    Attributes:
        max_speed_m_s: Maximum speed in m/s, also for steps `move`.
        max_height_m: Maximum height of a drone above its take-off point, in metres; without it no step flies the
            drone.
        fence_m: Maximum horizontal distance from the robot's start, in metres; required by steps that fly or drive
            it.
        battery_min: Approximate running time on one charge, in minutes; a note is shown for a longer trial.
    """

    max_speed_m_s: Number | Int
    max_height_m: Annotated[Number | Int, Field(gt=0)] | None = Field(default=None, exclude_if=schema.is_empty)
    fence_m: Annotated[Number | Int, Field(gt=0)] | None = Field(default=None, exclude_if=schema.is_empty)
    battery_min: Number | Int | None = None


class ProfileSection(Strict):
    """Base of the sections of a robot profile that installed packages add.

    Attributes:
        permission: Permission (`fieldkit.core.permissions`) that steps need to move a real robot by means of this
            section; empty if they do not move it.
        placement: Instruction to the operator who places a robot that steps move by means of this section. `{robot}`
            and `{other}`, the robot at the other end of its link, are filled in. Empty if no instruction is needed.
    """

    permission: ClassVar[str] = ""
    placement: ClassVar[str] = ""

    def contradiction(self, profile: "RobotProfile") -> str | None:  # noqa: ARG002 (most sections fit every profile)
        """Return the reason why the section contradicts the rest of the profile; None if it does not."""
        return None


class RobotProfile(catalog.Named, Sectioned):
    """A robot model: one YAML file in `robots/`.

    [Add a robot](add-a-robot.md) describes how to write a profile. A key described as "for information only" has no
    effect in this version.

    On an emulated robot, fieldkit writes setup files of ROS at the paths in the profile. A path directly in `/`, or
    below `/proc`, `/sys` or `/dev`, is rejected; files in `/run` and `/tmp` are lost at a reboot. It publishes
    topics of any type at their rates and sizes. For `sensor_msgs/LaserScan` (needs `points`), `Imu`,
    `BatteryState`, `Range`, `NavSatFix`, `MagneticField`, `FluidPressure`, `Temperature`, `nav_msgs/Odometry`,
    `tf2_msgs/TFMessage` and `geometry_msgs/PoseStamped` the values are the measurements of such a sensor on [the
    moving robot](add-a-robot.md#messages-of-an-emulated-robot). In messages of other types, strings are empty,
    numbers are 0, quaternions are the identity, and the first array of numbers is noise of the size in the profile.
    Types with a `definition` need ROS 1.

    Attributes:
        kind: `ugv` (ground), `uav` (air) or `usv` (water).
        computer: The on-board computer, for information only.
        radio: The radio under test.
        links: Network interface by the name of a link, for a robot with [several links](links.md): `{wifi: wlan0,
            cell: wwan0}`. The link with the interface of `radio` is the default of steps.
        tools: Programs on the robot, each a name or a path.
        ros: ROS settings of the robot; a robot without them records nothing.
        limits: Limits of the robot.
        unsupported: Reason why no trial can use a robot of this model; empty if trials can.
    """

    section_group = plugins.PROFILE_SECTIONS
    section_base = ProfileSection

    kind: Annotated[str, Field(pattern="^(ugv|uav|usv)$")]
    computer: str
    radio: Radio
    links: dict[LinkName, InterfaceName] = Field(default_factory=dict, exclude_if=schema.is_empty)
    tools: Tools = Tools.defaults()
    ros: Ros | None = None
    limits: Limits
    unsupported: str = Field(default="", exclude_if=schema.is_empty)

    @property
    def topics(self) -> tuple[PublishedTopic, ...]:
        """The topics that the robot publishes; empty without ROS."""
        return self.ros.topics if self.ros else ()

    @property
    def sections(self) -> Mapping[str, ProfileSection]:
        """Its sections of installed packages, by key."""
        extra = self.model_extra or {}
        return {key: section for key, section in extra.items() if isinstance(section, ProfileSection)}

    @schema.model_validator(mode="after")
    def _has_different_interfaces(self) -> "RobotProfile":
        if len(set(self.links.values())) < len(self.links):
            raise schema.validation_error("two links have the same interface", "links")
        return self

    @property
    def further_links(self) -> Mapping[str, str]:
        """Interface of each link besides the radio, by its name."""
        return {name: interface for name, interface in self.links.items() if interface != self.radio.interface}

    @schema.model_validator(mode="after")
    def _has_consistent_sections(self) -> "RobotProfile":
        for section in self.sections.values():
            if reason := section.contradiction(self):
                raise schema.validation_error(reason)
        return self


def load_profile(name: str) -> RobotProfile:
    """Return the profile `name`; the lab's folder is searched first.

    Raises:
        ConfigurationError: There is no such profile (the remedy contains the most similar name), or its file has an
            error.
    """
    return catalog.load("robots", name, RobotProfile)
