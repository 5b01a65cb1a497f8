"""Specification of an emulated robot: plain data that the lab sends to the robot's init process as JSON."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from ipaddress import IPv4Network
from typing import Any, Final, Literal, Self

from fieldkit.core.model import ROS_MASTER_PORT
from sim_backends.emulated.ros.sensor_specs import Definition, LaserTarget, Neighbour, Sensor, Template

SshServer = Literal["openssh", "dropbear"]
Userland = Literal["gnu", "busybox"]
Netcat = Literal["traditional", "openbsd", "ncat", "busybox"]
Ping = Literal["iputils", "busybox"]

NETCATS: Final[dict[Netcat, str]] = {
    "traditional": "nc.traditional",
    "openbsd": "nc.openbsd",
    "ncat": "ncat",
    "busybox": "busybox",
}
"""Debian's program for each netcat."""

USER: Final = "root"
HOME: Final = "/root"
STATE: Final = "/run/robot"
"""Folder in the robot that its init process writes to: files mounted over `/etc`, logs, readiness files."""
ROBOT_FILES: Final = tuple(f"/etc/{name}" for name in ("passwd", "group", "shadow", "hostname", "hosts"))
"""System files that each robot has separately."""
ROSCORE: Final = "/usr/bin/roscore"
"""Program of a ROS master that serves several robots."""

SSH_PORT: Final = 22
START_S: Final = 30.0
"""Timeout for the start of a robot's programs; Debian's ROS takes a few seconds on a busy machine."""

LOOPBACK_INTERFACE: Final = "lo"
"""Interface of a link without a device of its own: the robot has an address on its loopback interface, which the
routing daemon announces over every other link."""
SHARED_NETWORK: Final = IPv4Network("10.42.255.0/24")
"""Addresses of the robots on a link with the interface `LOOPBACK_INTERFACE`."""
LOOPBACK: Final = "127.0.0.1"

ANTENNA_M: Final = 0.2
"""Height of an antenna over the ground: a TurtleBot3 Burger is 0.19 m high (ROBOTIS e-Manual)."""

MESH_INTERFACE: Final = "bat0"
"""Mesh interface of batman-adv."""
WIFI_INTERFACE: Final = "wlan0"
"""Wi-Fi interface below that mesh interface."""

_KERNEL_FOLDERS: Final = ("/proc/", "/sys/", "/dev/")


@dataclass(frozen=True)
class Base:
    """Settings of the base controller of a ground robot.

    Attributes:
        topic: ROS topic of velocities that it subscribes to.
        type: Type of this topic, `geometry_msgs/Twist` or `geometry_msgs/TwistStamped`.
        speed_m_s: Maximum speed.
        acceleration_m_s2: Maximum acceleration.
        turn_rad_s: Maximum turn rate.
        is_simulated: True if the physics simulator of a co-simulation moves the robot: the base only records the
            velocities.
    """

    topic: str
    type: str
    speed_m_s: float
    acceleration_m_s2: float
    turn_rad_s: float
    is_simulated: bool = False


@dataclass(frozen=True)
class Ros2Spec:
    """Settings of a robot's ROS 2 nodes, which communicate over the radio.

    Attributes:
        middleware: `dds` or `zenoh`.
        distribution: ROS 2 distribution, which determines types and default behaviour.
        discovery: `multicast`, `peers` or `router`.
        peers: Addresses of the other robots, for `peers`; otherwise empty.
        router: Address of the robot that runs the router, for `router`; otherwise empty.
        domain: ROS domain.
    """

    middleware: str
    distribution: str
    discovery: str
    peers: tuple[str, ...]
    router: str
    domain: int

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Return the specification from the JSON of its `dataclasses.asdict`."""
        return cls(**{**data, "peers": tuple(data["peers"])})


@dataclass(frozen=True)
class WifiSpec:
    """Settings of Linux Wi-Fi on a robot.

    Attributes:
        mode: `ad hoc`, `mesh point`, `access point` or `station`.
        passphrase: Passphrase of the access point; empty without one.
        security: Security of the access point.
        has_monitor: True if the robot has a monitor interface, which captures all frames of its radio.
        background_scan: Setting `bgscan` of wpa_supplicant, with which a station finds other access points; or empty.
        channels: Number of channels of the 2.4 GHz band, from the first, that a station scans.
        forwards: True if the robot forwards IP packets, and its routing daemon finds the routes.
        originator_s: Originator interval of batman-adv, whose mesh interface then has the robot's address; None
            without batman-adv.
    """

    mode: Literal["ad hoc", "mesh point", "access point", "station"]
    passphrase: str = ""
    security: Literal["wpa2", "wpa3"] = "wpa2"
    has_monitor: bool = False
    background_scan: str = ""
    channels: int = 1
    forwards: bool = False
    originator_s: float | None = None

    def radio_interface(self, interface: str) -> str:
        """Return the name of the Wi-Fi interface of a robot with this interface under test."""
        return interface if self.originator_s is None else WIFI_INTERFACE


@dataclass(frozen=True)
class RobotSpec:
    """One emulated robot.

    Attributes:
        name: Its name in the lab, and its host name.
        interface: Name of its radio interface.
        address: Its IPv4 address on the radio with the prefix length, `10.42.0.1/24`.
        hosts: Addresses of all robots of the lab by name.
        host_key: Private host key of its SSH server, OpenSSH PEM.
        authorized_key: Public key that may log in.
        ros: Source of its ROS programs: `builtin` for those of this package, `debian` for Debian's.
        ros_version: 1 or 2; 1 for a robot without ROS.
        distribution: ROS distribution that its profile names; empty for a robot without ROS.
        setup: Setup files that its profile names.
        ros_master: Address of its ROS master: `LOOPBACK`, or the radio address of this or of another robot.
        sensors: Its sensors, one per published topic.
        registered_topics: Published topics that it registers at that master.
        definitions: Definitions of the message types of its sensors.
        mavlink_port: UDP port of its autopilot; None without an autopilot.
        simulated_flight: True if the physics simulator of a co-simulation flies it: the autopilot only records its
            commands.
        autopilot: Firmware that the autopilot emulates, `px4` or `ardupilot`.
        system: MAVLink system id of that autopilot.
        boot_s: Boot time of that autopilot.
        max_speed_m_s: Maximum speed.
        max_height_m: Maximum height of flight; None if its profile does not limit it.
        fence_m: Maximum distance from home in flight; None if its profile does not limit it.
        profile: Name of its profile, which determines its body.
        world: World that a drone flies in, as JSON; empty for other robots.
        laser_targets: Shapes of its world that its laser detects; empty without a laser.
        neighbours: The bodies of the other robots, which reflect its laser; empty without a laser.
        base: Its base controller; None if no program on the robot drives it.
        ssh: Its SSH server.
        sftp: True if that server offers SFTP.
        userland: Source of `sh`, `tar`, `ip` and similar tools.
        netcat: Its only netcat, as `nc` and by its full name; None for the netcat of this machine or of the userland.
        scripts: Programs that only this robot has: shell scripts by name.
        ping: Its `ping`; None for the `ping` of this machine or of the userland.
        mesh_hello_s: Hello interval of its routing daemon; None for a robot without a routing daemon.
        ros2: Settings of its ROS 2 nodes; None if no ROS 2 node communicates over the radio.
        routes_zenoh: True if it runs the Zenoh router.
        wifi: Settings of its Linux Wi-Fi; None for a robot whose radio is a TUN or TAP device.
        links: Interface and address with the prefix length of each further link (a link other than the radio under
            test), by the name of the link.
        bridge: Command that bridges its topics from ROS 1 to another middleware; empty if none runs automatically.
    """

    name: str
    interface: str
    address: str
    hosts: dict[str, str]
    host_key: str
    authorized_key: str
    ros: str
    ros_version: int
    distribution: str
    setup: tuple[str, ...]
    ros_master: str
    sensors: tuple[Sensor, ...]
    registered_topics: tuple[str, ...]
    definitions: dict[str, Definition]
    mavlink_port: int | None
    max_speed_m_s: float
    max_height_m: float | None
    fence_m: float | None
    profile: str
    world: str
    laser_targets: tuple[LaserTarget, ...] = ()
    neighbours: tuple[Neighbour, ...] = ()
    simulated_flight: bool = False
    autopilot: str = "px4"
    system: int = 1
    boot_s: float = 0.0
    base: Base | None = None
    ssh: SshServer = "openssh"
    sftp: bool = True
    userland: Userland = "gnu"
    netcat: Netcat | None = None
    ping: Ping | None = None
    scripts: dict[str, str] = field(default_factory=dict)
    mesh_hello_s: float | None = None
    ros2: Ros2Spec | None = None
    routes_zenoh: bool = False
    bridge: tuple[str, ...] = ()
    links: dict[str, tuple[str, str]] = field(default_factory=dict)
    wifi: WifiSpec | None = None

    @property
    def ip(self) -> str:
        """The address without the prefix length."""
        return self.address.partition("/")[0]

    @property
    def radio_interface(self) -> str:
        """The interface of the radio itself; in a mesh of batman-adv, `interface` is the mesh interface above it."""
        return self.interface if self.wifi is None else self.wifi.radio_interface(self.interface)

    @property
    def shares_master(self) -> bool:
        """True if its ROS master also serves other robots."""
        return self.ros_master != LOOPBACK

    @property
    def runs_master(self) -> bool:
        """True if its ROS master runs on the robot itself; also True for a robot without ROS."""
        return self.ros_master in {LOOPBACK, self.ip}

    @property
    def steers(self) -> bool:
        """True if a program on the robot may steer it."""
        return self.mavlink_port is not None or self.base is not None

    @property
    def waits_for_another(self) -> bool:
        """True if its startup may wait for another robot.

        It uses a ROS master that other robots use too, a Zenoh router, or an access point. The robot that runs this
        master or router is included.
        """
        is_station = self.wifi is not None and self.wifi.mode == "station"
        return self.shares_master or bool(self.ros2 and self.ros2.router) or is_station

    @property
    def ros1_environment(self) -> dict[str, str]:
        """Environment variables with the addresses of the ROS master and of this robot, for ROS 1 programs."""
        address = self.ip if self.shares_master else LOOPBACK
        return {"ROS_MASTER_URI": f"http://{self.ros_master}:{ROS_MASTER_PORT}", "ROS_IP": address}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Return the specification from the JSON of its `dataclasses.asdict`."""
        sensors = tuple(_sensor(sensor) for sensor in data["sensors"])
        definitions = {kind: Definition(**definition) for kind, definition in data["definitions"].items()}
        words = {name: tuple(data[name]) for name in ("setup", "registered_topics", "bridge")}
        base = data["base"] and Base(**data["base"])
        ros2 = data["ros2"] and Ros2Spec.from_json(data["ros2"])
        wifi = data["wifi"] and WifiSpec(**data["wifi"])
        targets = tuple(_laser_target(target) for target in data["laser_targets"])
        neighbours = tuple(Neighbour(*body) for body in data["neighbours"])
        parts = {"laser_targets": targets, "sensors": sensors, "definitions": definitions, "base": base, "ros2": ros2}
        links = {name: (interface, address) for name, (interface, address) in data["links"].items()}
        return cls(**{**data, **words, **parts, "neighbours": neighbours, "wifi": wifi, "links": links})


def unsupported_paths(paths: Iterable[str]) -> list[str]:
    """Return the paths at which a robot cannot have a file: in kernel folders or in the root directory."""
    return [path for path in paths if path.startswith(_KERNEL_FOLDERS) or path.count("/") == 1]


def _laser_target(data: dict[str, Any]) -> LaserTarget:
    outline_m = tuple((east_m, north_m) for east_m, north_m in data["outline_m"])
    return LaserTarget(**{**data, "outline_m": outline_m})


def _sensor(data: dict[str, Any]) -> Sensor:
    template = data["template"] and Template(**data["template"])
    return Sensor(**{**data, "template": template})
