"""Specification of an emulated robot: plain data that crosses from the lab to its init process as JSON."""

from dataclasses import dataclass
from typing import Any, Final, Literal, Self

from fieldkit.core.model import ROS_MASTER_PORT
from sim_backends.emulated.ros.laser import LaserTarget
from sim_backends.emulated.ros.messages import Definition, Sensor, Template
from sim_backends.emulated.ros.neighbours import Neighbour

SshServer = Literal["openssh", "dropbear"]
Userland = Literal["gnu", "busybox"]
Netcat = Literal["traditional", "openbsd", "ncat", "busybox"]
Ping = Literal["iputils", "busybox"]

USER: Final = "root"
HOME: Final = "/root"
STATE: Final = "/run/robot"
"""Folder in the robot of what its init process writes: files bound over `/etc`, logs, marks of readiness."""

LOOPBACK: Final = "127.0.0.1"

ANTENNA_M: Final = 0.2
"""Height of an antenna over the ground: a TurtleBot3 Burger is 0.19 m high (ROBOTIS e-Manual)."""

HELLO_S: Final = 4.0
"""How often babeld says hello on wireless interfaces by its own default."""


@dataclass(frozen=True)
class Base:
    """What a base controller of a ground robot is told.

    Attributes:
        topic: ROS topic that it listens to, of velocities.
        speed_m_s: Most that it drives.
        acceleration_m_s2: Most that its speed changes per second.
        turn_rad_s: Most that it turns.
    """

    topic: str
    speed_m_s: float
    acceleration_m_s2: float
    turn_rad_s: float


@dataclass(frozen=True)
class Ros2Spec:
    """How a robot with ROS 2 speaks over the radio.

    Attributes:
        over: `dds` or `zenoh`.
        distribution: Of ROS 2, whose types and habits it has.
        discovery: `multicast`, `peers` or `router`.
        peers: Addresses of the other robots, for `peers`.
        router: Address of the robot that runs the router, for `router`.
        domain: ROS domain.
    """

    over: str
    distribution: str
    discovery: str
    peers: tuple[str, ...]
    router: str
    domain: int

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Return what `dataclasses.asdict` and JSON made of it."""
        return cls(**{**data, "peers": tuple(data["peers"])})


@dataclass(frozen=True)
class RobotSpec:
    """One emulated robot.

    Attributes:
        name: Its name in the lab, and its host name.
        interface: Name of its radio interface.
        address: Its IPv4 address on the radio with the length of the network, `10.42.0.1/24`.
        hosts: Addresses of all robots of the lab by name.
        host_key: Private host key of its SSH server, OpenSSH PEM.
        authorized_key: Public key that may log in.
        ros: `builtin` or `debian`.
        ros_version: 1 or 2.
        distribution: ROS distribution that its profile names.
        setup: Setup files that its profile names.
        ros_master: Where its ROS master runs: `LOOPBACK`, or an address on the radio, its own or another robot's.
        sensors: What it publishes.
        registered: The topics of those that it publishes to that master.
        definitions: Those of its sensors' message types.
        mavlink_port: UDP port of its autopilot; None without.
        autopilot: `px4` or `ardupilot`, as which that answers.
        system: MAVLink system id of that autopilot.
        boot_s: Boot time of that autopilot.
        max_speed_m_s: How fast it is at most.
        max_height_m: How high it may fly; None where its profile does not say.
        fence_m: How far from home it may fly; None as above.
        profile: The name of its profile, by which its body is known.
        world: What a drone flies in, as JSON; empty for any other robot.
        laser_targets: What its laser sees of its world; empty without a laser.
        neighbours: The bodies of the other robots, which reflect its laser; empty without a laser.
        base: Its base controller; None where nothing in it drives it.
        ssh: Its SSH server.
        sftp: Whether that server offers SFTP.
        userland: Where `sh`, `tar`, `ip` and their like come from.
        netcat: Its only netcat, as `nc` and by its own name; None for what this machine or the userland has.
        ping: Its `ping`; None as for `netcat`.
        mesh_hello_s: How often its routing daemon says hello; None for a robot that does not forward.
        ros2: How it speaks ROS 2; None for a robot that does not.
        routes_zenoh: Whether it runs the router of those that speak over Zenoh.
        bridge: The command that carries its topics from ROS 1 to another middleware; empty where none runs by itself.
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
    registered: tuple[str, ...]
    definitions: dict[str, Definition]
    mavlink_port: int | None
    max_speed_m_s: float
    max_height_m: float | None
    fence_m: float | None
    profile: str
    world: str
    laser_targets: tuple[LaserTarget, ...] = ()
    neighbours: tuple[Neighbour, ...] = ()
    autopilot: str = "px4"
    system: int = 1
    boot_s: float = 0.0
    base: Base | None = None
    ssh: SshServer = "openssh"
    sftp: bool = True
    userland: Userland = "gnu"
    netcat: Netcat | None = None
    ping: Ping | None = None
    mesh_hello_s: float | None = None
    ros2: Ros2Spec | None = None
    routes_zenoh: bool = False
    bridge: tuple[str, ...] = ()

    @property
    def ip(self) -> str:
        """The address without the length of the network."""
        return self.address.partition("/")[0]

    @property
    def shares_master(self) -> bool:
        """Whether one ROS master serves it and other robots."""
        return self.ros_master != LOOPBACK

    @property
    def runs_master(self) -> bool:
        """Whether it runs its ROS master itself."""
        return self.ros_master in {LOOPBACK, self.ip}

    @property
    def steers(self) -> bool:
        """Whether something in it may steer it."""
        return self.mavlink_port is not None or self.base is not None

    @property
    def waits_for_another(self) -> bool:
        """Whether it is not up before another robot is: one with its ROS master, or with the router of its Zenoh."""
        return self.shares_master or bool(self.ros2 and self.ros2.router)

    @property
    def ros1_environment(self) -> dict[str, str]:
        """The variables by which ROS 1 programs find the master, and peers find them."""
        own = self.ip if self.shares_master else LOOPBACK
        return {"ROS_MASTER_URI": f"http://{self.ros_master}:{ROS_MASTER_PORT}", "ROS_IP": own}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """Return what `dataclasses.asdict` and JSON made of a specification."""
        sensors = tuple(_sensor(sensor) for sensor in data["sensors"])
        definitions = {kind: Definition(**definition) for kind, definition in data["definitions"].items()}
        words = {name: tuple(data[name]) for name in ("setup", "registered", "bridge")}
        base = data["base"] and Base(**data["base"])
        ros2 = data["ros2"] and Ros2Spec.from_json(data["ros2"])
        targets = tuple(_laser_target(target) for target in data["laser_targets"])
        neighbours = tuple(Neighbour(*body) for body in data["neighbours"])
        parts = {"laser_targets": targets, "sensors": sensors, "definitions": definitions, "base": base, "ros2": ros2}
        return cls(**{**data, **words, **parts, "neighbours": neighbours})


def _laser_target(data: dict[str, Any]) -> LaserTarget:
    outline_m = tuple((east_m, north_m) for east_m, north_m in data["outline_m"])
    return LaserTarget(**{**data, "outline_m": outline_m})


def _sensor(data: dict[str, Any]) -> Sensor:
    template = data["template"] and Template(**data["template"])
    return Sensor(**{**data, "template": template})
