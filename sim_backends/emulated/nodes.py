"""Handles on the nodes of an emulated lab: emulated robots, and the operator's laptop where SSH crosses the radio."""

import os
import socket
from dataclasses import asdict
from typing import Final, Self

from typing_extensions import override

from fieldkit.config.profiles import Radio
from fieldkit.core.errors import LinkError, RobotError, TestbedLostError
from sim_backends.emulated.process import namespaces
from sim_backends.emulated.process.worker import REPLY_S, Worker
from sim_backends.emulated.provisioning import LAPTOP_NAME
from sim_backends.emulated.robot.init import START_S
from sim_backends.emulated.robot.spec import HOME, RobotSpec
from sim_backends.emulated.robot.ssh_server import SSH_PORT
from sim_backends.emulated.ros.own_motion import OwnWay
from sim_backends.emulated.ros.steered import Steered, SteeredRecord

# Like the robots' own radios, so that a link is as good in both directions.
LAPTOP_RADIO: Final = Radio(interface="wlan0", standard="802.11n 2.4 GHz", tx_power_dbm=17, sensitivity_dbm=-82)


class Node:
    """A process tree in its own network, mount, PID, UTS and IPC namespaces; use as a context manager.

    It ends as a `Worker` does, and is made in a thread as that wants it. It is made at once; the first request waits
    until it is up.

    Args:
        name: Its name in the lab.
        interface: Name of its radio interface.
        address: Its IPv4 address on the radio with the length of the network, `10.42.0.1/24`.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(self, name: str, *, interface: str, address: str) -> None:
        self.name = name
        self.interface = interface
        self.address = address
        self._radio_fd: int | None = None
        self._worker = Worker(name, "sim_backends.emulated.robot.init", within=namespaces.command(), home=HOME)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the outermost process, whose end is the node's."""
        return self._worker.pid

    def open_radio(self, *, mesh: bool = False, guest_hello_s: float | None = None) -> None:
        """Bring up its radio interface.

        Args:
            mesh: Whether robots forward for each other.
            guest_hello_s: How often it says hello to robots that forward to it, and for which it forwards nothing;
                None for who starts a routing daemon of its own, or needs none.

        Raises:
            LinkError: It ended or did not answer.
            RobotError: Its kernel or its tools refused.
        """
        own = {"interface": self.interface, "address": self.address}
        request = {"do": "open radio", **own, "mesh": mesh, "guest_hello_s": guest_hello_s}
        _, (self._radio_fd,) = self._worker.ask(request)

    @property
    def radio_fd(self) -> int:
        """Descriptor of its TUN or TAP device, open as long as the node is up.

        Raises:
            RobotError: The radio was not opened.
        """
        if self._radio_fd is None:
            raise RobotError("its radio is off", where=self.name)
        return self._radio_fd

    def stream_to(self, host: str, port: int, timeout_s: float) -> socket.socket:
        """Return a TCP connection from inside its network namespace.

        Raises:
            OSError: There was none in time, or the node is busy.
            TestbedLostError: The node ended.
        """
        try:
            # Made there, connected here: whoever does not answer keeps this thread waiting, and not the node.
            _, (fd,) = self._worker.ask({"do": "socket"})
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

    def demand_up(self) -> None:
        """Return if the node runs; raises as `Worker.demand_up`."""
        self._worker.demand_up()

    def hang_up(self) -> None:
        """Let the node end, without waiting for it; requests under way fail at once."""
        self._worker.hang_up()

    def close(self) -> None:
        """End the node and wait until it is gone; does nothing the second time."""
        self._worker.close()
        if self._radio_fd is not None:
            os.close(self._radio_fd)
            self._radio_fd = None


class EmulatedRobot(Node):
    """A node with a file system of its own and a robot's programs.

    Args:
        spec: What it is told about itself.
        places_fd: Descriptor of the memory with the places of all robots (`neighbours.PlacesWriter`), open until it
            is built; None for a robot that is alone.

    Raises:
        ConfigurationError: As `Node`.
    """

    def __init__(self, spec: RobotSpec, places_fd: int | None = None) -> None:
        super().__init__(spec.name, interface=spec.interface, address=spec.address)
        self.spec = spec
        self._places_fd = places_fd
        self._record: SteeredRecord | None = None

    def build(self) -> None:
        """Give the robot its name and its own file system. Errors as `open_radio`."""
        shared = () if self._places_fd is None else (self._places_fd,)
        _, (fd,) = self._worker.ask({"do": "build", "robot": asdict(self.spec)}, descriptors=shared)
        self._record = SteeredRecord(fd)

    def steered(self) -> Steered | None:
        """Return how it moved by its own power, when it said so last; None if it never did. It is not asked."""
        return None if self._record is None else self._record.read()

    def start(self) -> None:
        """Start its programs and return when they serve. Errors as `open_radio`."""
        self._worker.ask({"do": "start", "robot": asdict(self.spec)}, timeout_s=START_S + REPLY_S)

    def switch_off(self) -> None:
        """Take its radio interface down. Errors as `open_radio`."""
        self._worker.ask({"do": "switch off", "interface": self.spec.interface})

    def switch_on(self) -> None:
        """Bring its radio interface up again. Errors as `open_radio`."""
        self._worker.ask({"do": "switch on", "interface": self.spec.interface})

    def kill(self, process: str) -> None:
        """End every process of this name. Errors as `open_radio`; there may be none."""
        self._worker.ask({"do": "kill", "process": process})

    def move(self, way: OwnWay) -> None:
        """Let its sensors know how it moves. Errors as `open_radio`."""
        self._worker.ask({"do": "move", "way": asdict(way)})

    def halt(self) -> None:
        """Take its power: all processes but its first end, what lies in memory is gone. Errors as `open_radio`."""
        self._worker.ask({"do": "halt", "interface": self.spec.interface})

    def boot(self) -> None:
        """Start it after `halt`: interface up, programs starting. Errors as `open_radio`."""
        self._worker.ask({"do": "boot", "interface": self.spec.interface, "robot": asdict(self.spec)})

    @override
    def close(self) -> None:
        super().close()
        if self._record is not None:
            self._record.close()
            self._record = None

    def connect(self, timeout_s: float) -> socket.socket:
        """Return a stream to its SSH server over its own loopback, past every radio. Errors as `stream_to`."""
        return self.stream_to("127.0.0.1", SSH_PORT, timeout_s)


class Laptop(Node):
    """A node that reaches robots over the medium.

    Args:
        address: Its address with the length of the network.

    Raises:
        ConfigurationError: As `Node`.
    """

    def __init__(self, address: str) -> None:
        super().__init__(LAPTOP_NAME, interface=LAPTOP_RADIO.interface, address=address)

    def reach(self, address: str, timeout_s: float) -> socket.socket:
        """Return a stream to the SSH server of the robot at `address`. Errors as `stream_to`."""
        return self.stream_to(address, SSH_PORT, timeout_s)
