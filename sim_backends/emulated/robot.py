"""The lab's handle on one emulated robot."""

import os
import socket
from dataclasses import asdict
from typing import Final, Self

from fieldkit.errors import LinkError, RobotError
from sim_backends.emulated.child import REPLY_S, Child
from sim_backends.emulated.init import START_S
from sim_backends.emulated.services import SSH_PORT
from sim_backends.emulated.spec import HOME, RobotSpec

_NAMESPACES: Final = ("--net", "--mount", "--propagation", "private", "--pid", "--uts", "--ipc")


class EmulatedRobot:
    """A process tree in its own network, mount, PID, UTS and IPC namespaces; use as a context manager.

    It ends as a `Child` does, and is made in a thread as that wants it. It is made at once; the first request waits
    until it is up.

    Args:
        spec: What it is told about itself.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        self._radio_fd: int | None = None
        within = ("unshare", *_NAMESPACES, "--fork", "--kill-child", "--")
        self._child = Child(spec.name, "sim_backends.emulated.init", within=within, home=HOME)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the outermost process, whose end is the robot's."""
        return self._child.pid

    def build(self) -> None:
        """Give the robot its name and its own file system.

        Raises:
            LinkError: It ended or did not answer.
            RobotError: Its kernel or its tools refused.
        """
        self._child.ask({"do": "build", "robot": asdict(self.spec)})

    def open_radio(self) -> None:
        """Bring up its radio interface. Errors as `build`."""
        request = {"do": "open radio", "interface": self.spec.interface, "address": self.spec.address}
        _, (self._radio_fd,) = self._child.ask(request)

    @property
    def radio_fd(self) -> int:
        """Descriptor of the TUN device, open as long as the robot is up.

        Raises:
            RobotError: The radio was not opened.
        """
        if self._radio_fd is None:
            raise RobotError("its radio is off", where=self.spec.name)
        return self._radio_fd

    def start(self) -> None:
        """Start its programs and return when they serve. Errors as `build`."""
        self._child.ask({"do": "start", "robot": asdict(self.spec)}, timeout_s=START_S + REPLY_S)

    def connect(self, timeout_s: float) -> socket.socket:
        """Return a stream to its SSH server, opened inside its network namespace.

        Raises:
            OSError: It did not give one in time.
        """
        try:
            _, (fd,) = self._child.ask({"do": "connect", "port": SSH_PORT}, timeout_s=timeout_s)
        except (LinkError, RobotError) as error:
            raise ConnectionError(error.what) from error
        return socket.socket(fileno=fd)

    def hang_up(self) -> None:
        """Let the robot end, without waiting for it; requests under way fail at once."""
        self._child.hang_up()

    def close(self) -> None:
        """End the robot and wait until it is gone; does nothing the second time."""
        self._child.close()
        if self._radio_fd is not None:
            os.close(self._radio_fd)
            self._radio_fd = None
