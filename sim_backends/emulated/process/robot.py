"""The lab's handle on one emulated robot."""

import socket
from dataclasses import asdict

from sim_backends.emulated.process.child import REPLY_S
from sim_backends.emulated.process.node import Node
from sim_backends.emulated.robot.init import START_S
from sim_backends.emulated.robot.spec import RobotSpec
from sim_backends.emulated.robot.ssh_server import SSH_PORT


class EmulatedRobot(Node):
    """A node with a file system of its own and a robot's programs.

    Args:
        spec: What it is told about itself.

    Raises:
        ConfigurationError: As `Node`.
    """

    def __init__(self, spec: RobotSpec) -> None:
        super().__init__(spec.name, interface=spec.interface, address=spec.address)
        self.spec = spec

    def build(self) -> None:
        """Give the robot its name and its own file system. Errors as `open_radio`."""
        self._child.ask({"do": "build", "robot": asdict(self.spec)})

    def start(self) -> None:
        """Start its programs and return when they serve. Errors as `open_radio`."""
        self._child.ask({"do": "start", "robot": asdict(self.spec)}, timeout_s=START_S + REPLY_S)

    def switch_off(self) -> None:
        """Take its radio interface down. Errors as `open_radio`."""
        self._child.ask({"do": "switch off", "interface": self.spec.interface})

    def switch_on(self) -> None:
        """Bring its radio interface up again. Errors as `open_radio`."""
        self._child.ask({"do": "switch on", "interface": self.spec.interface})

    def kill(self, process: str) -> None:
        """End every process of this name. Errors as `open_radio`; there may be none."""
        self._child.ask({"do": "kill", "process": process})

    def halt(self) -> None:
        """Take its power: all processes but its first end, what lies in memory is gone. Errors as `open_radio`."""
        self._child.ask({"do": "halt", "interface": self.spec.interface})

    def boot(self) -> None:
        """Start it after `halt`: interface up, programs starting. Errors as `open_radio`."""
        self._child.ask({"do": "boot", "interface": self.spec.interface, "robot": asdict(self.spec)})

    def connect(self, timeout_s: float) -> socket.socket:
        """Return a stream to its SSH server over its own loopback, past every radio. Errors as `stream_to`."""
        return self.stream_to("127.0.0.1", SSH_PORT, timeout_s)
