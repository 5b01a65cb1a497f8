"""The `emulated:` section of a site file."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final, Literal

from fieldkit.config import schema
from fieldkit.config.profiles import LinkName
from fieldkit.config.schema import Bool, Document, Duration, Field, Length, Strict
from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.linux_wifi.linux_wifi_options import LinuxWifiOptions
from sim_backends.emulated.robot.mesh_options import MeshOptions
from sim_backends.emulated.robot.spec import NETCATS, Netcat, Ping, SshServer, Userland
from sim_backends.radio.radio_options import INFRASTRUCTURE, RadioOptions

BOOT_S: Final = 2.0
"""Default of the option `boot`."""
LATE_BOUND_S: Final = 0.1
"""Default of the option `late_bound`."""


class RosChoice(StrEnum):
    """Source of a robot's ROS."""

    AUTO = "auto"
    DEBIAN = "debian"
    BUILTIN = "builtin"


ROS_FILES: Final = ("/usr/bin/rosbag", "/usr/bin/rosmaster", "/usr/lib/python3/dist-packages/rospy")
"""Files whose presence shows that Debian's ROS is installed."""


def uses_debian_ros(choice: RosChoice) -> bool:
    """Return True if robots with ROS 1 use Debian's ROS, by choice or because it is installed."""
    if choice is RosChoice.AUTO:
        return all(Path(path).exists() for path in ROS_FILES)
    return choice is RosChoice.DEBIAN


ScriptName = Annotated[str, schema.pattern_field(r"^[A-Za-z0-9][A-Za-z0-9._+-]{0,40}$", "the name of a program")]


class RobotOptions(Strict):
    """Tool variants of one robot; for a tool that is not named, the robot uses the tool of this machine.

    Attributes:
        ssh: Its SSH server: `openssh` or `dropbear`.
        sftp: True if that server offers SFTP.
        userland: `gnu` or `busybox`. With `busybox`, `sh`, `tar`, `ip` and similar programs are busybox's, and
            programs that busybox lacks are missing.
        netcat: `traditional`, `openbsd`, `ncat` or `busybox`: its only netcat, installed as `nc` and under its own
            name. If omitted, it has the netcats of this machine, or with `userland: busybox` that of busybox.
        ping: `iputils` or `busybox`; if omitted, that of this machine, or with `userland: busybox` that of busybox.
        scripts: Programs that only this robot has, as shell scripts by name, which replace those of this machine:
            `{vcgencmd: echo throttled=0x50005}`. See [state of the robots](robot-state.md#emulated-robots).
    """

    ssh: SshServer = "openssh"
    sftp: Bool = True
    userland: Userland = "gnu"
    netcat: Netcat | None = None
    ping: Ping | None = None
    scripts: dict[ScriptName, str] = Field(default_factory=dict)

    def programs(self) -> set[str]:
        """Return the programs that these variants need on this machine, in addition to those that every lab needs."""
        programs = {"dropbear", "dropbearconvert"} if self.ssh == "dropbear" else set()
        if self.netcat is not None:
            programs.add(NETCATS[self.netcat])
        return programs | ({"busybox"} if "busybox" in {self.userland, self.ping} else set())


HOST_TOOLS: Final = RobotOptions.defaults()
"""Options of a robot that the site file does not name under `robots`: it has the tools of this machine."""


class Ros2Options(Strict):
    """Discovery between the ROS 2 nodes of different robots over the radio.

    Attributes:
        discovery: `multicast`: by multicast (DDS) or scouting (Zenoh). `peers`: each robot has a list of the
            addresses of all others. `router`: by a router, which only Zenoh has.
        router: The robot that runs the router; required for `discovery: router`, otherwise not allowed.
    """

    discovery: Literal["multicast", "peers", "router"] = "multicast"
    router: str | None = None

    @schema.model_validator(mode="after")
    def _check_router(self) -> "Ros2Options":
        if (self.discovery == "router") != (self.router is not None):
            raise schema.validation_error(
                "`discovery: router` and `router: ROBOT` must be given together; ROBOT runs the router", "router"
            )
        return self


class SyncOptions(Strict):
    """The [sync policy](method-cosim.md#sync-policies) of a lab on the co-simulation.

    Attributes:
        name: Its name. `event_driven` adds no delay to a packet.
        window: Length of a window, or the parameter w of the velocity-aware policies.
        longest: Longest window of policies with variable windows.
        bound: For `error_bounded`: largest error of the relative position of two robots in the network.
        step: Time step of the physics.
    """

    name: str = "event_driven"
    window: Annotated[Duration, Field(gt=0)] = 0.001
    longest: Annotated[Duration, Field(gt=0)] = 0.1
    bound: Annotated[Length, Field(gt=0)] = 0.01
    step: Annotated[Duration, Field(ge=1e-6, le=0.1)] = 0.001

    @schema.model_validator(mode="before")
    @classmethod
    def _expand_name(cls, value: object) -> object:
        """Accept a name without parameters."""
        return {"name": value} if isinstance(value, str) else value

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters with the names that policies use, in SI units."""
        return {"window_s": self.window, "longest_s": self.longest, "bound_m": self.bound}

    @property
    def step_ns(self) -> int:
        """Time step of the physics simulator in nanoseconds."""
        return round(self.step * 1e9)


class EmulatedOptions(Strict):
    """Options of the emulated backend.

    Attributes:
        ros: `debian`: ROS's master and rosbag from Debian. `builtin`: fieldkit's rosbag, without a master, which
            [needs less processor time](add-a-robot.md#built-in-or-debians-ros). `auto`: Debian's if they are
            installed. Robots with ROS 2 always use fieldkit's, are refused with `debian`, and [communicate over the
            radio](add-a-robot.md#ros-2-over-the-radio) unless this is `builtin` or their middleware is not installed.
        ros2: Discovery between robots with ROS 2.
        robots: Variants of tools, by robot; the default is the tools of this machine. See [add a
            robot](add-a-robot.md#variants-of-tools).
        world: The world around the robots: a file in the folder `worlds/` of the lab, or a shipped one (`lawn`,
            `baylands`, `open`). See [world file](reference/world-file.md).
        radio: The radio between the robots: Wi-Fi in that world, unless one of `loss`, `delay`, `rate` and `jitter`
            fixes the links.
        links: The medium of each [further link](links.md) of the profiles, by the link's name, with the keys of
            `radio`: `{cell: {rate: 20Mbit/s, delay: 40ms, loss: 1%}}`.
        late_bound: Maximum delay that the emulator may add to a packet, before and after the radio model in total.
            If it is exceeded, the repeat is void.
        record_air: True to write every transmission attempt and ACK to `air.pcap` and `air.csv` of each repeat;
            fixed links have none.
        boot: Time for which a robot that reboots is off before its programs start.
        mesh: Robots forward packets for each other, and a routing protocol finds the routes: [a mesh](mesh.md).
        physics: Physics simulator of [the co-simulation](lab-cosim.md) that moves the robots: `kinematic`, `mujoco`
            or `gazebo`. The default is `kinematic` if `network` is given.
        network: The network of the co-simulation: `builtin` or `ns3`. The default is `builtin` if `physics`
            is given.
        sync: The sync policy between physics and network: its name, or name and parameters. The default is
            `event_driven`, which adds no delay; with `ns3` it is `{name: sliding_window, window: 2ms}`, and with
            `gazebo` the same with 10 ms, because an exchange at every event takes too long for real time.
        wifi: `model`: the Wi-Fi of fieldkit's radio. `linux`: [Linux Wi-Fi](linux-wifi.md), over the same radio,
            in a virtual machine if this kernel has no mac80211_hwsim, or the user is not root.
        linux_wifi: Settings of Linux Wi-Fi.
    """

    ros: RosChoice = RosChoice.AUTO
    ros2: Ros2Options = Ros2Options.defaults()
    robots: dict[str, RobotOptions] = Field(default_factory=dict)
    world: str = "lawn"
    radio: RadioOptions = RadioOptions.defaults()
    links: dict[LinkName, RadioOptions] = Field(default_factory=dict, exclude_if=schema.is_empty)
    late_bound: Annotated[Duration, Field(gt=0)] = LATE_BOUND_S
    record_air: Bool = False
    boot: Annotated[Duration, Field(ge=0)] = BOOT_S
    mesh: MeshOptions | None = None
    physics: Literal["kinematic", "mujoco", "gazebo"] | None = None
    network: Literal["builtin", "ns3"] | None = None
    sync: SyncOptions | None = None
    wifi: Literal["model", "linux"] = "model"
    linux_wifi: LinuxWifiOptions = LinuxWifiOptions.defaults()

    @property
    def has_linux_wifi(self) -> bool:
        """True if the robots have Linux Wi-Fi."""
        return self.wifi == "linux"

    @property
    def babel_hello_s(self) -> float | None:
        """Hello interval of the robots' babeld; None if they run no babeld."""
        return self.mesh.hello_s if self.mesh is not None and self.mesh.protocol == "babel" else None

    @property
    def has_batman(self) -> bool:
        """True if the robots form a mesh of batman-adv."""
        return self.mesh is not None and self.mesh.protocol == "batman-adv"

    @property
    def is_cosimulated(self) -> bool:
        """True if the robots run on the co-simulation."""
        return self.physics is not None or self.network is not None

    @schema.model_validator(mode="after")
    def _check_sync(self) -> "EmulatedOptions":
        if self.sync is not None and not self.is_cosimulated:
            raise schema.validation_error(
                "`sync` needs a co-simulation; write for example `physics: kinematic`", "sync"
            )
        if self.links and self.is_cosimulated:
            raise schema.validation_error("a co-simulation has one network; remove `links`", "links")
        return self

    @schema.model_validator(mode="after")
    def _check_network(self) -> "EmulatedOptions":
        if self.network in {None, "builtin"}:
            return self
        for key, is_used, feature in (
            ("radio", self.radio.is_fixed, "fixed links (`loss`, `delay`, `rate` or `jitter`)"),
            ("radio", self.radio.has_infrastructure, ", ".join(f"`{name}`" for name in INFRASTRUCTURE)),
            ("record_air", self.record_air, "`record_air`"),
            ("mesh", self.mesh is not None, "`mesh`"),
        ):
            if is_used:
                cause = (
                    f"the network {self.network} does not support {feature}; remove it, or write `network: builtin`"
                )
                raise schema.validation_error(cause, key)
        return self

    def with_wifi(self, kind: str) -> "EmulatedOptions":
        """Return a copy with another `wifi`.

        Raises:
            ConfigurationError: This Wi-Fi cannot be combined with other options of the lab.
        """
        try:
            return EmulatedOptions.model_validate(self.model_dump(mode="json") | {"wifi": kind})
        except schema.ValidationError as error:
            cause = error.errors()[0]["msg"]
            raise ConfigurationError(cause, remedy="change emulated: in the site file") from error

    @schema.model_validator(mode="after")
    def _check_wifi(self) -> "EmulatedOptions":
        excluded_options = {
            "physics": self.physics,
            "network": self.network,
            "record_air": self.record_air,
            "links": self.links,
            "radio": self.radio.is_fixed,
        }
        for key, value in excluded_options.items():
            if self.has_linux_wifi and value:
                name = "a fixed link (loss, delay, rate or jitter)" if key == "radio" else f"`{key}`"
                raise schema.validation_error(f"`wifi: linux` cannot be combined with {name}", key)
        if self.has_linux_wifi and (self.radio.neighbours or self.radio.microwave_ovens):
            cause = "`wifi: linux` cannot be combined with `radio.neighbours` or `radio.microwave_ovens`"
            raise schema.validation_error(cause, "radio")
        if self.has_linux_wifi and self.linux_wifi.mesh and self.radio.access_points:
            cause = "`linux_wifi: {mesh: true}` cannot be combined with `radio.access_points`"
            raise schema.validation_error(cause, "linux_wifi")
        if self.has_linux_wifi and self.linux_wifi.mesh and self.mesh is not None:
            raise schema.validation_error("`linux_wifi: {mesh: true}` cannot be combined with `mesh`", "linux_wifi")
        if self.has_batman and not self.has_linux_wifi:
            cause = "`mesh: {protocol: batman-adv}` needs `wifi: linux`; otherwise write `protocol: babel`"
            raise schema.validation_error(cause, "mesh")
        if self.mesh is not None and self.radio.access_points:
            raise schema.validation_error("`mesh` cannot be combined with `radio.access_points`", "mesh")
        return self


def load_options(document: Document | None) -> EmulatedOptions:
    """Return the options in a site file's document, or the defaults if it has no section `emulated`.

    Raises:
        ConfigurationError: The section is wrong; the message names the file and the line.
    """
    if document is None or not document.data.get("emulated"):
        return EmulatedOptions.defaults()
    return schema.validate(document.part("emulated"), EmulatedOptions)
