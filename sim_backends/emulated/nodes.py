"""Handles and startup of the nodes of an emulated lab: robots and the operator's laptop."""

import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Generic, Self

from typing_extensions import override

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import Radio
from fieldkit.core.errors import LinkError, RobotError, TestbedLostError
from fieldkit.lab.robots import LabRobot
from sim_backends.emulated import placement
from sim_backends.emulated.emulated_options import EmulatedOptions, RosChoice
from sim_backends.emulated.medium.framing import ETHERNET, IP, Framing
from sim_backends.emulated.medium.media import Media
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.emulated.process import namespaces
from sim_backends.emulated.process.worker import REPLY_S, Worker
from sim_backends.emulated.provisioning import LAPTOP_NAME, KeyPair, RobotKey, robot_spec
from sim_backends.emulated.robot.init import START_S
from sim_backends.emulated.robot.spec import HOME, RobotSpec, WifiSpec
from sim_backends.emulated.robot.ssh_server import SSH_PORT
from sim_backends.emulated.ros.laser import PositionsWriter
from sim_backends.emulated.ros.motion_record import MotionRecord, RecordedMotion
from sim_backends.emulated.ros.robot_motion import AssignedPath
from sim_backends.radio.antennas import antenna_of, fixed_mode
from sim_backends.world.world import World

if TYPE_CHECKING:
    from sim_backends.emulated.linux_wifi.radios import HwsimRadio

# The same radio as on robots, so that a link has the same quality in both directions.
LAPTOP_RADIO: Final = Radio(interface="wlan0", standard="802.11n 2.4 GHz", tx_power_dbm=17, sensitivity_dbm=-82)


class Node:
    """A process tree in its own network, mount, PID, UTS and IPC namespaces; use as a context manager.

    The process starts when the object is created, and the first request waits until the process is ready. The kernel
    kills the process when the thread that created the object ends, so create it in a thread that exists as long as
    the lab.

    Args:
        name: Its name in the lab.
        interface: Name of its radio interface.
        address: Its IPv4 address on the radio with the prefix length, `10.42.0.1/24`.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(self, name: str, *, interface: str, address: str) -> None:
        self.name = name
        self.interface = interface
        self.address = address
        self._radio_fd: int | None = None
        self._worker = Worker(
            name, "sim_backends.emulated.robot.init", command_prefix=namespaces.command(), home=HOME
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the outermost process; when it exits, all processes of the node exit."""
        return self._worker.pid

    def open_radio(self, *, mesh: bool = False, guest_hello_s: float | None = None) -> None:
        """Bring up the radio interface.

        Args:
            mesh: True if robots forward packets for each other.
            guest_hello_s: Hello interval of the routing daemon of the laptop, which uses the robots' routes but
                forwards no packets. None for a robot, or without a mesh.

        Raises:
            LinkError: The node has exited or did not answer.
            RobotError: A kernel call or a tool failed.
        """
        link = {"interface": self.interface, "address": self.address}
        request = {"do": "open radio", **link, "mesh": mesh, "guest_hello_s": guest_hello_s}
        _, (self._radio_fd,) = self._worker.request(request)

    @property
    def has_device(self) -> bool:
        """True if its radio is a TUN or TAP device."""
        return self._radio_fd is not None

    @property
    def radio_fd(self) -> int:
        """Descriptor of its TUN or TAP device, open as long as the node runs.

        Raises:
            RobotError: The radio was not opened.
        """
        if self._radio_fd is None:
            raise RobotError("its radio has not been opened", where=self.name)
        return self._radio_fd

    def stream_to(self, host: str, port: int, timeout_s: float) -> socket.socket:
        """Return a TCP connection from inside the node's network namespace.

        Raises:
            OSError: The connection was not made in time, or the node is busy.
            TestbedLostError: The node has exited.
        """
        try:
            # The socket is created in the node and connected here, so a slow peer blocks this thread, not the node.
            _, (fd,) = self._worker.request({"do": "socket"})
        except TestbedLostError:
            raise
        except (LinkError, RobotError) as error:
            raise ConnectionError(error.what) from error
        stream = socket.socket(fileno=fd)
        try:
            stream.settimeout(timeout_s)
            stream.connect((host, port))
        except BaseException:
            stream.close()
            raise
        return stream

    def check_alive(self) -> None:
        """Raise the errors of `Worker.check_alive` if the node does not run."""
        self._worker.check_alive()

    def request_exit(self) -> None:
        """Request that the node stops, without waiting for it; pending requests fail immediately."""
        self._worker.request_exit()

    def close(self) -> None:
        """Stop the node and wait until its processes have exited; a second call does nothing."""
        self._worker.close()
        if self._radio_fd is not None:
            os.close(self._radio_fd)
            self._radio_fd = None


class EmulatedRobot(Node):
    """A node with a separate file system and a robot's programs.

    Args:
        spec: Specification of the robot.
        positions_fd: Descriptor of the shared memory that holds the positions of all robots
            (`laser.PositionsWriter`). It must stay open until `build` has returned; None for a robot without
            neighbours.

    Attributes:
        spec: Specification of the robot.
        physics_fds: Descriptors for a physics simulator that moves the robot, set by `build`: its motion record, its
            file of assigned paths, and either its record of commanded velocities or, for a robot with an autopilot,
            its records of commands and of flight. Empty if no simulator moves the robot.
        link_fds: Descriptor of the TUN device of each further link (a link beside the radio under test), by its name,
            after `open_links`.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(self, spec: RobotSpec, positions_fd: int | None = None) -> None:
        super().__init__(spec.name, interface=spec.interface, address=spec.address)
        self.spec = spec
        self._positions_fd = positions_fd
        self._record: MotionRecord | None = None
        self.physics_fds: Sequence[int] = ()
        self.link_fds: dict[str, int] = {}

    def build(self) -> None:
        """Give the robot its host name and its file system. Raises the errors of `open_radio`."""
        shared_fds = () if self._positions_fd is None else (self._positions_fd,)
        request = {"do": "build", "robot": asdict(self.spec)}
        _, (motion_record_fd, *simulator_fds) = self._worker.request(request, descriptors=shared_fds)
        self._record = MotionRecord(motion_record_fd)
        self.physics_fds = (motion_record_fd, *simulator_fds) if simulator_fds else ()

    def open_wifi(self, device: str) -> None:
        """Bring up the Wi-Fi interface `device` in the robot's namespace. Raises the errors of `open_radio`."""
        if self.spec.wifi is None:
            raise RobotError("the robot has no Linux Wi-Fi", where=self.name)
        link = {"device": device, "interface": self.interface, "address": self.address}
        self._worker.request({"do": "open wifi", "wifi": asdict(self.spec.wifi), **link})

    def recorded_motion(self) -> RecordedMotion | None:
        """Return the last motion that the robot recorded, or None if it never steered itself. Sends no request."""
        return None if self._record is None else self._record.read()

    def start(self) -> None:
        """Start the robot's programs and return when they are ready. Raises the errors of `open_radio`."""
        self._worker.request({"do": "start", "robot": asdict(self.spec)}, timeout_s=START_S + REPLY_S)

    def open_links(self) -> None:
        """Bring up the interfaces of its further links. Raises the errors of `open_radio`."""
        for name, (interface, address) in self.spec.links.items():
            mesh = self.spec.mesh_hello_s is not None
            _, fds = self._worker.request(
                {"do": "open link", "interface": interface, "address": address, "mesh": mesh}
            )
            if fds:
                (self.link_fds[name],) = fds

    def switch_off(self, link: str = "") -> None:
        """Take down the interface of a further link, or of the radio without `link`.

        Raises the errors of `open_radio`.
        """
        interface, _ = self.spec.links.get(link, (self.spec.interface, ""))
        self._worker.request({"do": "switch off", "interface": interface})

    def switch_on(self, link: str = "") -> None:
        """Bring up the interface that `switch_off` has taken down. Raises the errors of `open_radio`."""
        if link in self.spec.links:
            self._worker.request({"do": "switch link on", "interface": self.spec.links[link][0]})
        else:
            self._worker.request({"do": "switch on", "interface": self.spec.interface})

    @property
    def _interfaces(self) -> list[str]:
        return [self.spec.interface, *(self.spec.links[name][0] for name in self.link_fds)]

    def kill(self, process: str) -> None:
        """Kill every process of this name.

        Raises the errors of `open_radio`, and RobotError if there is no such process.
        """
        self._worker.request({"do": "kill", "process": process})

    def move(self, path: AssignedPath) -> None:
        """Send the robot the path on which the lab moves it. Raises the errors of `open_radio`."""
        self._worker.request({"do": "move", "path": asdict(path)})

    def halt(self) -> None:
        """Emulate a loss of power: kill all processes except init, and clear the folders that are in memory.

        Raises the errors of `open_radio`.
        """
        self._worker.request({"do": "halt", "interfaces": self._interfaces})

    def boot(self) -> None:
        """Boot after `halt`: bring up the interfaces and start the programs, without waiting until they are ready.

        Raises the errors of `open_radio`.
        """
        self._worker.request({"do": "boot", "interfaces": self._interfaces, "robot": asdict(self.spec)})

    @override
    def close(self) -> None:
        super().close()
        if self._record is not None:
            self._record.close()
            self._record = None
        for fd in (*self.physics_fds[1:], *self.link_fds.values()):  # the motion record has closed the first one
            os.close(fd)
        self.physics_fds = ()
        self.link_fds = {}

    def connect(self, timeout_s: float) -> socket.socket:
        """Return a TCP connection to the robot's SSH server over its loopback, which bypasses the radio.

        Raises the errors of `stream_to`.
        """
        return self.stream_to("127.0.0.1", SSH_PORT, timeout_s)


class Laptop(Node):
    """A node from which SSH reaches the robots over the medium.

    Args:
        address: Its address with the prefix length.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(self, address: str) -> None:
        super().__init__(LAPTOP_NAME, interface=LAPTOP_RADIO.interface, address=address)

    def reach(self, address: str, timeout_s: float) -> socket.socket:
        """Return a TCP connection to the SSH server of the robot at `address`. Raises the errors of `stream_to`."""
        return self.stream_to(address, SSH_PORT, timeout_s)


_MAX_PARALLEL_STARTS: Final = 16
"""Maximum number of robots that are built and started at the same time; each needs a thread and processor time."""


@dataclass(frozen=True)
class RunningRobots(Generic[RobotKey]):
    """Running robots, attached to their media but not placed yet.

    Attributes:
        robots: The robots.
        medium: The medium of the radio under test.
        media: This medium and those of further links.
        positions_writer: Writer of the robots' positions, for the lasers of the other robots.
        host_keys: Public host key of each robot.
        private_key: Private key that logs in on all robots, OpenSSH PEM.
    """

    robots: Mapping[RobotKey, EmulatedRobot]
    medium: MediumClient
    media: Media
    positions_writer: PositionsWriter
    host_keys: Mapping[RobotKey, str]
    private_key: str = field(repr=False)


@contextmanager
def running_robots(
    robots: Mapping[RobotKey, Robot | LabRobot],
    *,
    options: EmulatedOptions,
    world: World,
    ros: RosChoice,
    seed: int,
) -> Iterator[RunningRobots[RobotKey]]:
    """Yield robots whose programs are ready; leaving the context stops all their processes.

    The arguments are those of `testbed.bring_up`. Robots that share a ROS master or a Zenoh router start 1 m apart,
    and connect to it over the radio.

    Raises:
        ConfigurationError: The site file fixes a radio mode that one of the robots does not have.
        FieldkitError: A robot or the medium did not start.
    """
    fixed_mode(options.radio.mode, {robot.name: antenna_of(robot.profile.radio) for robot in robots.values()})
    login, host_keys = KeyPair.make(), {key: KeyPair.make() for key in robots}
    with ExitStack() as stack:
        framing = IP if options.mesh is None else ETHERNET  # in a mesh, MAC addresses identify the next hop
        wifi: Mapping[RobotKey, WifiSpec] = {}
        radios: Mapping[str, HwsimRadio] = {}
        if options.has_linux_wifi:
            from sim_backends.emulated.linux_wifi import lab  # noqa: PLC0415 (only some labs use it)

            forwards = options.mesh is not None
            wifi = lab.wifi_specs(robots, options.linux_wifi, options.radio, forwards=forwards)
            radios = lab.radios_of(robots.values(), options.radio)
            medium: MediumClient = stack.enter_context(lab.medium(options.radio, world, seed, radios, wifi.values()))
        elif options.is_cosimulated:
            medium = stack.enter_context(_cosimulated_medium(options, world, robots, seed, framing))
        else:
            medium = stack.enter_context(MediumClient(options.radio, world, seed=seed, framing=framing))
        used_links = {name for robot in robots.values() for name in robot.profile.further_links}
        links = {
            name: stack.enter_context(MediumClient(link_options, world, seed=seed, framing=framing))
            for name, link_options in options.links.items()
            if name in used_links
        }
        media = Media(medium, links)
        positions_writer = stack.enter_context(closing(PositionsWriter([robot.name for robot in robots.values()])))
        # The pool is shut down after the robots have exited, because a waiting request ends when its robot exits.
        pool = stack.enter_context(ThreadPoolExecutor(min(len(robots), _MAX_PARALLEL_STARTS)))
        running: dict[RobotKey, EmulatedRobot] = {}
        for key in robots:
            spec = robot_spec(
                robots, key, ros=ros, login=login, host_key=host_keys[key], options=options, world=world
            )
            spec = replace(spec, wifi=wifi.get(key))
            running[key] = stack.enter_context(EmulatedRobot(spec, positions_writer.fd))
        list(pool.map(partial(_build, radios=radios), running.values()))
        # Robots with a ROS master start first, because the other robots wait for it.
        startups = pool.map(
            EmulatedRobot.start, sorted(running.values(), key=lambda robot: not robot.spec.runs_master)
        )
        for key, robot in running.items():
            radio, fd = robots[key].profile.radio, robot.radio_fd if robot.has_device else None
            medium.attach(robot.name, robot.address, radio, fd, physics_fds=robot.physics_fds)
            for name, link_fd in robot.link_fds.items():
                links[name].attach(robot.name, robot.spec.links[name][1], radio, link_fd)
        if any(robot.spec.waits_for_another for robot in running.values()):
            names = [*(robot.name for robot in running.values()), *(options.radio.access_points if wifi else ())]
            media.place(placement.side_by_side_m(names))
        list(startups)  # waits until the programs are ready, and raises their errors
        yield RunningRobots(
            running,
            medium,
            media,
            positions_writer,
            {key: pair.public for key, pair in host_keys.items()},
            login.private,
        )
        for robot in running.values():
            robot.request_exit()


def _cosimulated_medium(
    options: EmulatedOptions, world: World, robots: Mapping[RobotKey, Robot | LabRobot], seed: int, framing: Framing
) -> MediumClient:
    """Start the medium of a lab on the co-simulation."""
    from sim_backends.emulated import simulator_choice  # noqa: PLC0415 (other labs import no simulator)
    from sim_backends.emulated.cosimulated.client import CosimulatedClient  # noqa: PLC0415 (as above)

    simulators = simulator_choice.resolve(options)
    sync = simulator_choice.sync_of(options)
    policy = {"name": sync.name, **sync.parameters}
    bodies = simulator_choice.bodies_of(robots.values())
    return CosimulatedClient(
        options.radio, world, seed=seed, framing=framing, bodies=bodies, simulators=simulators, policy=policy
    )


def _build(robot: EmulatedRobot, radios: "Mapping[str, HwsimRadio]") -> None:
    """Build a robot and bring up its interfaces; `radios` are the kernel's radios of robots with Linux Wi-Fi."""
    robot.build()
    radio = radios.get(robot.name)
    if radio is not None:
        radio.move_to_namespace(robot.pid)
        robot.open_wifi(radio.interface)
        return
    robot.open_radio(mesh=robot.spec.mesh_hello_s is not None)
    robot.open_links()
