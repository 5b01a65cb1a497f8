"""Services of an emulated robot, and their start: as a program or as a fork of init."""

import gc
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Final

from fieldkit.core.model import BRIDGE_IS_UP, ROS_MASTER_PORT
from fieldkit.remote.command import with_environment
from sim_backends.emulated.autopilot import mavlink_server as autopilot
from sim_backends.emulated.process import worker
from sim_backends.emulated.robot import base_process, network, ssh_server
from sim_backends.emulated.robot.spec import ANTENNA_M, HOME, ROSCORE, SSH_PORT, STATE, RobotSpec
from sim_backends.emulated.ros import sensors, static_frames, tcpros
from sim_backends.emulated.ros.lab_positions import Neighbourhood

_LOG_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_APPEND
_LOG_MODE: Final = 0o600

ASSIGNED_PATHS: Final = Path(STATE, "motion")
"""The file of the paths on which the lab moves the robot."""

MOTION_RECORD: Final = Path(STATE, "steered")
"""The file in which a robot that steers itself records its motion."""

FLIGHT_COMMAND: Final = Path(STATE, "flight_command")
"""The file in which an autopilot records its command for the physics simulator that moves the drone."""

FLIGHT: Final = Path(STATE, "flown")
"""The file in which the physics simulator records the motion of the drone for its autopilot."""

READY_FOLDER: Final = f"{STATE}/ready"

_ROSMASTER: Final = "/usr/bin/rosmaster"
_RELAY: Final = Path(__file__).with_name("ros_relay.py")

BRIDGE: Final = "bridge"
ROS2_RELAY: Final = "ros2_relay"
ZENOH_ROUTER: Final = "zenoh_router"
_ROS2_MODULE: Final = "sim_backends.emulated.robot.ros2_relay"


def spawn(argv: tuple[str, ...], environment: Mapping[str, str], log: Path) -> int:
    """Start a program in a new session, with its output in `log`; return its process id.

    Raises:
        OSError: The program is missing.
    """
    return os.posix_spawn(
        argv[0],
        argv,
        environment,
        file_actions=[
            (os.POSIX_SPAWN_OPEN, 0, "/dev/null", os.O_RDONLY, 0),
            (os.POSIX_SPAWN_OPEN, 1, str(log), _LOG_FLAGS, _LOG_MODE),
            (os.POSIX_SPAWN_DUP2, 1, 2),
        ],
        setsid=True,
        setsigmask=[],
        setsigdef=[signal.SIGPIPE, signal.SIGXFSZ],  # Python ignores these signals, and a program would inherit that
    )


def fork(name: str, work: Callable[[], None], log: Path) -> int:
    """Call `work` in a forked process of this name and in a new session; return the process id.

    Its output is written to `log`. The fork inherits the memory of this process, but no descriptors. Call it from a
    process with one thread.
    """
    gc.freeze()  # a garbage collection in the fork would write to, and so copy, every page of inherited objects
    pid = os.fork()
    if pid == 0:
        os._exit(_run(name, work, log))
    return pid


def name_process(name: str) -> None:
    """Set the name of this process in `ps`, which would otherwise show the interpreter."""
    Path("/proc/self/comm").write_text(name, encoding="ascii")


def _run(name: str, work: Callable[[], None], log: Path) -> int:
    """Run `work` in a forked process; return its exit code."""
    try:
        name_process(name)
        _detach(log)
        work()
    except BaseException:  # noqa: BLE001 (every error must end this process, not return into the code of its parent)
        sys.stdout.flush()  # so that the output precedes the traceback in the log
        sys.excepthook(*sys.exc_info())
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def _detach(log: Path) -> None:
    """Detach from the session, the descriptors and the signal handling of the parent process."""
    os.setsid()
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(os.open(log, _LOG_FLAGS, _LOG_MODE), 1)
    os.dup2(1, 2)
    os.closerange(3, os.sysconf("SC_OPEN_MAX"))


@dataclass(frozen=True)
class Service:
    """Program or forked process that runs as long as the robot.

    Attributes:
        name: Name of the service and of its log in `/run/robot`.
        launch: Starts it with its output in a log; returns its process id.
        ready: Returns True if it is ready.
    """

    name: str
    launch: Callable[[Path], int]
    ready: Callable[[], bool]


def services(spec: RobotSpec, neighbourhood: Neighbourhood | None = None) -> list[Service]:
    """Return the services of the robot that `spec` describes.

    Args:
        spec: The robot.
        neighbourhood: Positions of the lab's robots; None for a robot without neighbours.
    """
    frames = static_frames.links(spec.sensors)
    publish = partial(sensors.publish, spec.sensors, spec.definitions, frames=frames, targets=spec.laser_targets)
    if neighbourhood is not None and spec.neighbours:
        publish = partial(publish, moving_targets=partial(neighbourhood.targets, spec.neighbours))
    result = [
        _program("sshd", ssh_server.command(spec), {}, lambda: network.has_listener(SSH_PORT)),
        _motion_service("sensors", publish),
    ]
    if spec.mavlink_port is not None:
        result.append(_motion_service("autopilot", partial(autopilot.serve, _drone(spec, spec.mavlink_port))))
    if spec.base is not None:
        result.append(_motion_service("base", partial(base_process.serve, spec.base)))
    result += _network_services(spec)
    if spec.ros == "debian":
        result += _debian_ros(spec, (*spec.registered_topics, *([static_frames.TOPIC] if frames else [])))
    if spec.bridge:
        argv = ("/usr/bin/env", *with_environment(spec.bridge, setup=spec.setup))
        result.append(_program(BRIDGE, argv, {}, _bridge_is_up))
    if spec.routes_zenoh:
        result.append(_ros2_program(ZENOH_ROUTER, "route", spec.ip))
    if spec.ros2 is not None:
        types = {sensor.topic: sensor.type for sensor in spec.sensors}
        if frames:
            types[static_frames.TOPIC] = static_frames.TYPE
        words = (spec.ip, ros_node(spec), *_velocity_topic(spec), json.dumps(asdict(spec.ros2)), json.dumps(types))
        result.append(_ros2_program(ROS2_RELAY, "relay", *words))
    return result


def _network_services(spec: RobotSpec) -> Iterator[Service]:
    """Yield the programs of the robot's radio: hostapd or wpa_supplicant, and the routing daemon of a mesh."""
    wifi = spec.wifi
    if wifi is not None:
        from sim_backends.emulated.robot import wireless  # noqa: PLC0415 (only some labs use it)

        if wifi.mode in wireless.PROGRAMS:
            argv = wireless.prepare_command(spec.interface, wifi)
            yield _program(wireless.PROGRAMS[wifi.mode], argv, {}, partial(wireless.is_connected, wifi))
    if spec.mesh_hello_s is not None:
        argv = network.babeld_command(spec.interface, spec.address, spec.mesh_hello_s, dict(spec.links.values()))
        yield _program("babeld", argv, {}, partial(network.has_udp6_socket, network.BABEL_PORT))


def _motion_service(name: str, serve: Callable[..., None]) -> Service:
    """Return a service that reads or records the robot's motion; it is a fork of this process."""
    ready = ready_file(name)
    work = partial(serve, assigned_paths=ASSIGNED_PATHS, motion_record=MOTION_RECORD, ready=ready)
    return Service(name, partial(fork, name, work), ready.exists)


def _debian_ros(spec: RobotSpec, topics: Sequence[str]) -> Iterator[Service]:
    """Yield the robot's ROS master, if it runs one, and the node that publishes `topics` there."""
    # The relay runs under Debian's interpreter, because rospy is installed for it.
    variables = spec.ros1_environment | {"PYTHONPATH": str(worker.PROJECT)}
    if spec.runs_master:
        yield _master(spec, variables)
    relay = ("/usr/bin/python3", "-s", str(_RELAY), ros_node(spec), *_velocity_topic(spec), *topics)
    yield _program("ros_relay", relay, variables, ready_file("ros_relay").exists)


def _velocity_topic(spec: RobotSpec) -> tuple[str, str]:
    """Return the topic of velocities that the robot's base subscribes to, and its type; "" and "" without a base."""
    return (spec.base.topic, spec.base.type) if spec.base else ("", "")


def _drone(spec: RobotSpec, port: int) -> autopilot.Drone:
    """Return the settings of the robot's autopilot."""
    return autopilot.Drone(
        system=spec.system,
        port=port,
        autopilot=spec.autopilot,
        profile=spec.profile,
        max_speed_m_s=spec.max_speed_m_s,
        max_height_m=spec.max_height_m,
        fence_m=spec.fence_m,
        antenna_m=ANTENNA_M,
        world=spec.world,
        boot_s=spec.boot_s,
        physics=autopilot.PhysicsFiles(FLIGHT_COMMAND, FLIGHT) if spec.simulated_flight else None,
    )


def ros_node(spec: RobotSpec) -> str:
    """Return the name of the node that publishes the sensors.

    The name contains the robot's name if nodes of several robots share a network. Of two nodes with the same name, a
    ROS master shuts down the older one, and ROS 2 cannot distinguish them.
    """
    name = tcpros.CALLER.strip("/")
    return f"{name}_{spec.name.replace('-', '_')}" if spec.shares_master or spec.ros2 is not None else name


def _master(spec: RobotSpec, variables: Mapping[str, str]) -> Service:
    """Return the robot's ROS master: roscore if it serves other robots too, otherwise only the master process."""
    port = ("-p", str(ROS_MASTER_PORT))
    name, argv = ("roscore", (ROSCORE, *port)) if spec.shares_master else ("rosmaster", (_ROSMASTER, "--core", *port))
    return _program(name, argv, variables, lambda: network.has_listener(ROS_MASTER_PORT))


def _program(name: str, argv: tuple[str, ...], variables: Mapping[str, str], ready: Callable[[], bool]) -> Service:
    environment = {"PATH": os.environ["PATH"], "LANG": os.environ["LANG"], "HOME": HOME, **variables}
    return Service(name, partial(spawn, argv, environment), ready)


def _bridge_is_up() -> bool:
    log = Path(STATE, f"{BRIDGE}.log")
    return log.exists() and BRIDGE_IS_UP in log.read_text(encoding="utf-8", errors="replace")


def _ros2_program(name: str, *words: str) -> Service:
    argv = (*worker.command(_ROS2_MODULE), *words)
    return _program(name, argv, {"PYTHONPATH": str(worker.PROJECT)}, ready_file(name).exists)


def ready_file(name: str) -> Path:
    """Return the file that the service `name` creates when it is ready."""
    return Path(READY_FOLDER, name)
