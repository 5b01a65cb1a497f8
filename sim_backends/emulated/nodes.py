"""Handles of the nodes of an emulated lab: robots and the operator's laptop."""

import os
import socket
from collections.abc import Sequence
from dataclasses import asdict
from typing import Final, Self

from typing_extensions import override

from fieldkit.config.profiles import Radio
from fieldkit.core.errors import LinkError, RobotError, TestbedLostError
from sim_backends.emulated.process import namespaces
from sim_backends.emulated.process.worker import REPLY_S, Worker
from sim_backends.emulated.provisioning import LAPTOP_NAME
from sim_backends.emulated.robot.spec import HOME, SSH_PORT, START_S, RobotSpec
from sim_backends.emulated.ros.assigned_path import AssignedPath
from sim_backends.emulated.ros.motion_record import MotionRecord, RecordedMotion

# The radio of the shipped robot profiles, so that a link has the same quality in both directions.
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
        """True if its radio is a TUN or TAP device, which `open_radio` has opened."""
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
            (`lab_positions.PositionsWriter`). It must stay open until `build` has returned; None for a robot without
            neighbours.

    Attributes:
        spec: Specification of the robot.
        physics_fds: Descriptors for a physics simulator that moves the robot, set by `build`: its motion record, its
            file of assigned paths, and either its record of commanded velocities or, for a robot with an autopilot,
            its records of commands and of flight. Empty if no simulator moves the robot.
        link_fds: Descriptor of the TUN or TAP device of each further link (a link beside the radio under test), by
            its name, after `open_links`. A link on the loopback interface has no device.

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
        """Return the last motion that the robot recorded, or None if it never steered itself or does not run.

        The motion is read from shared memory; the robot gets no request.
        """
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
        interface, _ = self.spec.links.get(link, (self.spec.radio_interface, ""))
        self._worker.request({"do": "switch off", "interface": interface})

    def switch_on(self, link: str = "") -> None:
        """Bring up the interface that `switch_off` has taken down. Raises the errors of `open_radio`."""
        if link in self.spec.links:
            self._worker.request({"do": "switch link on", "interface": self.spec.links[link][0]})
        else:
            self._worker.request({"do": "switch on", "interface": self.spec.radio_interface})

    @property
    def _interfaces(self) -> list[str]:
        return [self.spec.radio_interface, *(self.spec.links[name][0] for name in self.link_fds)]

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
