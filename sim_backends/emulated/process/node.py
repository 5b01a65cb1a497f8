"""The lab's handle on one node of its network: namespaces with a radio, held by an init process."""

import os
import socket
from typing import Self

from fieldkit.core.errors import LinkError, RobotError
from sim_backends.emulated.process import namespaces
from sim_backends.emulated.process.child import Child
from sim_backends.emulated.robot.spec import HOME


class Node:
    """A process tree in its own network, mount, PID, UTS and IPC namespaces; use as a context manager.

    It ends as a `Child` does, and is made in a thread as that wants it. It is made at once; the first request waits
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
        self._child = Child(name, "sim_backends.emulated.robot.init", within=namespaces.command(), home=HOME)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the outermost process, whose end is the node's."""
        return self._child.pid

    def open_radio(self) -> None:
        """Bring up its radio interface.

        Raises:
            LinkError: It ended or did not answer.
            RobotError: Its kernel or its tools refused.
        """
        request = {"do": "open radio", "interface": self.interface, "address": self.address}
        _, (self._radio_fd,) = self._child.ask(request)

    @property
    def radio_fd(self) -> int:
        """Descriptor of the TUN device, open as long as the node is up.

        Raises:
            RobotError: The radio was not opened.
        """
        if self._radio_fd is None:
            raise RobotError("its radio is off", where=self.name)
        return self._radio_fd

    def stream_to(self, host: str, port: int, timeout_s: float) -> socket.socket:
        """Return a TCP connection from inside its network namespace.

        Raises:
            OSError: There was none in time, or the node does not answer.
        """
        try:
            # Made there, connected here: whoever does not answer keeps this thread waiting, and not the node.
            _, (fd,) = self._child.ask({"do": "socket"})
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

    def hang_up(self) -> None:
        """Let the node end, without waiting for it; requests under way fail at once."""
        self._child.hang_up()

    def close(self) -> None:
        """End the node and wait until it is gone; does nothing the second time."""
        self._child.close()
        if self._radio_fd is not None:
            os.close(self._radio_fd)
            self._radio_fd = None
