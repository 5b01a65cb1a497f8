"""Provisioning of emulated robots: addresses, SSH keys, message definitions, and the specification of each robot.

Each lab has new keys, which are never written to the host's disk. This is the only module that imports
`cryptography`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from ipaddress import IPv4Address, IPv4Network
from typing import TYPE_CHECKING, Final, Self, TypeVar

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import PublishedTopic, RobotProfile
from fieldkit.core.errors import ConfigurationError
from sim_backends.emulated.emulated_options import HOST_TOOLS, EmulatedOptions, RosChoice, uses_debian_ros
from sim_backends.emulated.motion_sections import drive_of, mavlink_of
from sim_backends.emulated.robot.spec import (
    ANTENNA_M,
    LOOPBACK,
    LOOPBACK_INTERFACE,
    MESH_INTERFACE,
    SHARED_NETWORK,
    Base,
    RobotSpec,
    Ros2Spec,
)
from sim_backends.emulated.ros import message_definitions, static_frames
from sim_backends.emulated.ros.sensor_specs import (
    GENERATED_TYPES,
    LASER_SCAN,
    Definition,
    LaserTarget,
    Neighbour,
    Sensor,
)
from sim_backends.world.shapes import Cylinder, Shape
from sim_backends.world.world import World

if TYPE_CHECKING:
    from fieldkit.lab.robots import LabRobot

NETWORK: Final = IPv4Network("10.42.0.0/24")
LAPTOP_ADDRESS: Final = NETWORK[-2]
"""Address of the laptop; robots have lower addresses."""
LAPTOP_NAME: Final = "laptop"

_DEFAULTS: Final = EmulatedOptions.defaults()

BRIDGE_TIMEOUT_S: Final = 20
"""Time limit for the connection of a bridge to the ROS master, which is started at the same time."""

RobotKey = TypeVar("RobotKey")
"""Type of the keys that identify robots: a role in a trial, a name in an interactive lab."""


@dataclass(frozen=True)
class KeyPair:
    """An ed25519 key.

    Attributes:
        private: OpenSSH PEM text.
        public: `ssh-ed25519 AAAA...`.
    """

    private: str
    public: str

    @classmethod
    def make(cls) -> Self:
        """Return a new key."""
        # Importing cryptography takes 50 ms, and a dry run uses this module without making a key.
        from cryptography.hazmat.primitives import serialization  # noqa: PLC0415
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415

        key = Ed25519PrivateKey.generate()
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH, serialization.NoEncryption()
        )
        public = key.public_key().public_bytes(serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH)
        return cls(private.decode(), public.decode())


@cache
def definition(kind: str, text: str = "") -> Definition:
    """Return the definition of the ROS 1 message type `package/Name`; `text` is used if ROS has no such type.

    Raises the errors of `message_definitions.definition_of`.
    """
    return message_definitions.definition_of(kind, text)


def sensors_of(robot: "Robot | LabRobot") -> tuple[Sensor, ...]:
    """Return the sensors of a robot, one per published topic. Raises the errors of `templates.template_of`."""
    return tuple(_sensor(topic) for topic in robot.profile.topics)


def _definitions(robot: "Robot | LabRobot") -> dict[str, Definition]:
    """Return the definitions of the message types that a robot publishes.

    Raises the errors of `message_definitions.definition_of` and of `sensors_of`.
    """
    definitions = {topic.type: definition(topic.type, topic.definition) for topic in robot.profile.topics}
    if static_frames.links(sensors_of(robot)):
        definitions[static_frames.TYPE] = definition(static_frames.TYPE)
    return definitions


def _sensor(topic: PublishedTopic) -> Sensor:
    sensor = Sensor(topic.name, topic.type, topic.rate, topic.frame, topic.points, child_frame=topic.child_frame)
    if topic.type in GENERATED_TYPES:
        return sensor
    from sim_backends.emulated.ros import templates  # noqa: PLC0415 (few topics have other types)

    return replace(sensor, template=templates.template_of(topic))


def laser_targets(world: World) -> tuple[LaserTarget, ...]:
    """Return the obstacles of a world in the form in which a robot's laser uses them."""
    return tuple(_laser_target(part.shape) for part in world.parts)


def _laser_target(shape: Shape) -> LaserTarget:
    # The bottom of a shape is as far below its centre as the top is above it.
    base_m, top_m = shape.centre_m[2] - (shape.top_m - shape.centre_m[2]), shape.top_m
    if isinstance(shape, Cylinder):
        return LaserTarget((shape.centre_m[:2],), shape.radius_m, base_m, top_m)
    return LaserTarget(shape.corners_m(), 0.0, base_m, top_m)


def _neighbours(robots: "Mapping[RobotKey, Robot | LabRobot]", key: RobotKey) -> tuple[Neighbour, ...]:
    """Return the bodies of the other robots, numbered by their positions in `robots`."""
    return tuple(
        neighbour(number, robot.profile) for number, (other, robot) in enumerate(robots.items()) if other != key
    )


def neighbour(number: int, profile: RobotProfile) -> Neighbour:
    """Return the body of a robot as a cylinder: from `ANTENNA_M` below its antenna up to the antenna.

    If the robot is higher than its antenna, the cylinder ends at the top of the robot.

    A robot whose body is unknown has the body of the paper's ground robot or of the paper's drone.
    """
    from sim_backends.physics.robot_limits import (  # noqa: PLC0415 (a dry run makes no robots)
        BODIES,
        TURTLEBOT3_BURGER,
        quadrotor,
    )

    default = quadrotor(profile.name) if profile.kind == "uav" else TURTLEBOT3_BURGER
    body = BODIES.get(profile.name, default)
    return Neighbour(number, body.radius_m, ANTENNA_M, max(body.height_m - ANTENNA_M, 0.0))


def ros_master_of(robot: "Robot | LabRobot") -> str:
    """Return the address of the ROS master that a robot uses; in an interactive lab each robot runs a master."""
    return (robot.ros_master if isinstance(robot, Robot) else "") or LOOPBACK


def _registered_topics(robots: "Mapping[RobotKey, Robot | LabRobot]", key: RobotKey) -> tuple[str, ...]:
    """Return the topics that a robot registers at its ROS master.

    If robots share a master, a topic that several of them have is registered only by the first one. With real robots,
    too, only one of them publishes it: their drivers have the same node names, and a master shuts down a node when
    another one registers with its name.
    """
    registered: set[str] = set()
    for other in robots:
        topics = [topic.name for topic in robots[other].profile.topics]
        if other == key:
            return tuple(topic for topic in topics if topic not in registered)
        if ros_master_of(robots[other]) == ros_master_of(robots[key]) != LOOPBACK:
            registered.update(topics)
    raise KeyError(key)


def drives_by_topic(profile: RobotProfile, options: EmulatedOptions) -> bool:
    """Return True if robots of a profile can be driven by a topic of Debian's ROS 1, or of ROS 2 over the radio.

    The result is False in a lab with a Zenoh router, because the program that drives a robot connects only to ROS
    nodes on the same robot.
    """
    ros = profile.ros
    if drive_of(profile) is None or ros is None:
        return False
    if ros.variant == "ros1":
        return uses_debian_ros(options.ros)
    return ros2_middleware(profile, options) != "" and options.ros2.router is None


def ros2_middleware(profile: RobotProfile, options: EmulatedOptions) -> str:
    """Return the middleware of a profile's ROS 2 over the radio: `dds`, `zenoh`, or "" if it has none.

    The result is also "" if the site file selects the built-in ROS, or if the middleware is not installed on this
    machine.
    """
    ros = profile.ros
    if ros is None or ros.variant != "ros2" or options.ros is RosChoice.BUILTIN:
        return ""
    package = {"dds": "cyclonedds"}.get(ros.middleware, ros.middleware)
    return ros.middleware if find_spec(package) else ""


def profile_in_lab(profile: RobotProfile, options: EmulatedOptions) -> RobotProfile:
    """Return a profile with the interface under test that the robot has in the lab.

    In a mesh of batman-adv this is the mesh interface, even if the profile names the Wi-Fi interface below it.
    """
    if not options.has_batman:
        return profile
    radio = profile.radio.model_copy(update={"interface": MESH_INTERFACE})
    links = {
        name: MESH_INTERFACE if interface == profile.radio.interface else interface
        for name, interface in profile.links.items()
    }
    return profile.model_copy(update={"radio": radio, "links": links})


def link_addresses(profile: RobotProfile, address: str, options: EmulatedOptions) -> dict[str, str]:
    """Return a robot's address on each further link that the lab emulates, by the link's name.

    Args:
        profile: The robot's profile.
        address: Its address on the radio; all its addresses have the same last byte.
        options: The lab's options.

    Raises:
        ConfigurationError: The lab does not emulate a link of the profile.
    """
    last_byte = int(IPv4Address(address)) - int(NETWORK.network_address)
    # The Nth link in alphabetical order has the network 10.42.N.0/24.
    networks = {name: NETWORK.network_address + 256 * number for number, name in enumerate(sorted(options.links), 1)}
    # In a mesh, a link on the loopback interface is a second address of the robot, reachable over all other links.
    for name, interface in profile.further_links.items():
        if interface == LOOPBACK_INTERFACE and options.babel_hello_s is not None:
            networks[name] = SHARED_NETWORK.network_address
        if name not in networks:
            has_address_only = interface == LOOPBACK_INTERFACE
            example = (
                "mesh: {protocol: babel, hello: 0.5s}"
                if has_address_only
                else f"links: {{{name}: {{rate: 20Mbit/s, delay: 40ms}}}}"
            )
            raise ConfigurationError(
                f"profile {profile.name} has the link {name!r}, which the lab does not emulate",
                where="emulated",
                remedy=f"write for example emulated: {{{example}}}",
            )
    return {name: str(networks[name] + last_byte) for name in profile.further_links}


def _prefix_length(interface: str) -> int:
    return 32 if interface == LOOPBACK_INTERFACE else NETWORK.prefixlen


def _base(profile: RobotProfile, *, is_simulated: bool) -> Base | None:
    """Return the settings of a robot's base controller; None if its profile has no section `drive`."""
    drive = drive_of(profile)
    if drive is None:
        return None
    limits = profile.limits
    return Base(
        drive.topic, drive.type, limits.max_speed_m_s, drive.acceleration_m_s2, drive.turn_rad_s, is_simulated
    )


def _ros2_spec(
    robots: "Mapping[RobotKey, Robot | LabRobot]", robot: "Robot | LabRobot", options: EmulatedOptions
) -> Ros2Spec | None:
    """Return the settings of a robot's ROS 2 over the radio.

    The result is None if the robot has no ROS 2 over the radio, or if this machine lacks the middleware.

    Raises:
        ConfigurationError: The robot with the router is not among `robots`.
    """
    ros, middleware = robot.profile.ros, ros2_middleware(robot.profile, options)
    if ros is None or not middleware:
        return None
    addresses = {other.name: other.address for other in robots.values()}
    settings = options.ros2
    if settings.router is not None and settings.router not in addresses:
        raise ConfigurationError(
            f"emulated.ros2.router is {settings.router}, which is not in this trial",
            where=robot.name,
            remedy=f"name one of: {', '.join(addresses)}; or write discovery: multicast",
        )
    peers = tuple(address for address in addresses.values() if address != robot.address)
    return Ros2Spec(
        middleware=middleware,
        distribution=ros.command.distribution,
        discovery=settings.discovery,
        peers=peers if settings.discovery == "peers" else (),
        router=addresses[settings.router] if settings.router else "",
        domain=ros.domain,
    )


def _bridge(robot: "Robot | LabRobot") -> tuple[str, ...]:
    """Return the command of the bridge that starts with the robot in an interactive lab.

    It is empty in a trial, and for a profile without a bridge.
    """
    ros = robot.profile.ros
    if ros is None or ros.bridge is None or isinstance(robot, Robot):
        return ()
    return ros.bridge.command(robot.address, "", BRIDGE_TIMEOUT_S)


def robot_spec(
    robots: "Mapping[RobotKey, Robot | LabRobot]",
    key: RobotKey,
    *,
    ros: RosChoice,
    login: KeyPair,
    host_key: KeyPair,
    options: EmulatedOptions = _DEFAULTS,
    world: World | None = None,
) -> RobotSpec:
    """Return the specification of a robot; `world` is needed for a robot that flies or has a laser."""
    robot = robots[key]
    tools = options.robots.get(robot.name, HOST_TOOLS)
    profile_ros = robot.profile.ros
    is_ros2 = profile_ros is not None and profile_ros.variant == "ros2"
    ros2_over_radio = _ros2_spec(robots, robot, options)
    has_debian_ros1 = ros is RosChoice.DEBIAN and profile_ros is not None and not is_ros2
    mavlink, limits = mavlink_of(robot.profile), robot.profile.limits
    has_laser = any(topic.type == LASER_SCAN for topic in robot.profile.topics)
    return RobotSpec(
        name=robot.name,
        interface=robot.profile.radio.interface,
        address=f"{robot.address}/{NETWORK.prefixlen}",
        hosts={other.name: other.address for other in robots.values()},
        host_key=host_key.private,
        authorized_key=login.public,
        # `debian` is Debian's ROS 1; robots with ROS 2 or without ROS do not use it.
        ros=(RosChoice.BUILTIN if is_ros2 or profile_ros is None else ros).value,
        ros_version=2 if is_ros2 else 1,
        distribution=profile_ros.command.distribution if profile_ros else "",
        setup=profile_ros.command.setup if profile_ros else (),
        ros_master=ros_master_of(robot),
        sensors=sensors_of(robot),
        registered_topics=_registered_topics(robots, key),
        definitions=_definitions(robot),
        mavlink_port=mavlink.port if mavlink else None,
        simulated_flight=mavlink is not None and options.is_cosimulated,
        max_speed_m_s=limits.max_speed_m_s,
        max_height_m=limits.max_height_m,
        fence_m=limits.fence_m,
        profile=robot.profile.name,
        world=world.model_dump_json() if world is not None and mavlink else "",
        laser_targets=laser_targets(world) if world is not None and has_laser else (),
        neighbours=_neighbours(robots, key) if has_laser else (),
        autopilot=mavlink.autopilot if mavlink else "px4",
        system=mavlink.system if mavlink else 1,
        boot_s=float(mavlink.boot_s) if mavlink else 0.0,
        base=_base(robot.profile, is_simulated=options.is_cosimulated)
        if has_debian_ros1 or ros2_over_radio is not None
        else None,
        mesh_hello_s=options.babel_hello_s,
        ros2=ros2_over_radio,
        bridge=_bridge(robot),
        links={
            name: (interface := robot.profile.further_links[name], f"{address}/{_prefix_length(interface)}")
            for name, address in link_addresses(robot.profile, robot.address, options).items()
        },
        routes_zenoh=options.ros2.router == robot.name,
        **tools.model_dump(),
    )
