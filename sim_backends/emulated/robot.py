"""The lab's handle on one emulated robot."""

import os
import socket
import subprocess
import tempfile
import threading
from dataclasses import asdict
from typing import IO, Final, Self

from fieldkit.deadline import Deadline
from fieldkit.errors import ConfigurationError, LinkError, RobotError
from sim_backends.emulated import medium_wire, system
from sim_backends.emulated.init import START_S
from sim_backends.emulated.medium_wire import Message
from sim_backends.emulated.services import SSH_PORT
from sim_backends.emulated.spec import HOME, RobotSpec

PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

_REPLY_S: Final = 15.0
_END_S: Final = 2.0

_NAMESPACES: Final = ("--net", "--mount", "--propagation", "private", "--pid", "--uts", "--ipc")


class EmulatedRobot:
    """A process tree in its own network, mount, PID, UTS and IPC namespaces; use as a context manager.

    It ends with this object, and with this process however that ends: the control socket closes, and the kernel
    kills it with the thread that called `spawn`. So call `spawn` from a thread that lives as long as the lab. The
    other methods may be called from any thread.
    """

    def __init__(
        self, spec: RobotSpec, channel: socket.socket, process: subprocess.Popen[bytes], log: IO[bytes]
    ) -> None:
        self.spec = spec
        self._channel = channel
        self._process = process
        self._log = log
        self._turn = threading.Lock()
        self._radio_fd: int | None = None

    @classmethod
    def spawn(cls, spec: RobotSpec) -> Self:
        """Start the robot's first process; returns at once, the first request waits until it is up.

        Raises:
            ConfigurationError: `setpriv` is missing.
        """
        ours, theirs = socket.socketpair()
        log = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the process; `close` closes it)
        kernel_ends_it = ("setpriv", "--pdeathsig", "KILL", "--")
        in_namespaces = ("unshare", *_NAMESPACES, "--fork", "--kill-child", "--")
        argv = [*kernel_ends_it, *in_namespaces, *system.python("sim_backends.emulated.init"), str(theirs.fileno())]
        try:
            process = subprocess.Popen(
                argv,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                # Ctrl-C in a terminal reaches the whole group; the lab decides when a robot ends.
                start_new_session=True,
                env={"PATH": PATH, "HOME": HOME, "LANG": "C.UTF-8", "PYTHONPATH": str(system.PROJECT)},
                cwd="/",
            )
        except OSError as error:
            ours.close()
            log.close()
            raise ConfigurationError(
                f"cannot start an emulated robot: {error}", remedy="apt-get install util-linux"
            ) from error
        finally:
            theirs.close()
        return cls(spec, ours, process, log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the outermost process, whose end is the robot's."""
        return self._process.pid

    def build(self) -> None:
        """Give the robot its name and its own file system.

        Raises:
            LinkError: It ended or did not answer.
            RobotError: Its kernel or its tools refused.
        """
        self._ask({"do": "build", "robot": asdict(self.spec)})

    def open_radio(self) -> None:
        """Bring up its radio interface. Errors as `build`."""
        request = {"do": "open radio", "interface": self.spec.interface, "address": self.spec.address}
        (self._radio_fd,) = self._ask(request)

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
        self._ask({"do": "start", "robot": asdict(self.spec)}, START_S + _REPLY_S)

    def connect(self, timeout_s: float) -> socket.socket:
        """Return a stream to its SSH server, opened inside its network namespace.

        Raises:
            OSError: It did not give one in time.
        """
        try:
            (fd,) = self._ask({"do": "connect", "port": SSH_PORT}, timeout_s)
        except (LinkError, RobotError) as error:
            raise ConnectionError(error.what) from error
        return socket.socket(fileno=fd)

    def hang_up(self) -> None:
        """Let the robot end, without waiting for it; requests under way fail at once."""
        if self._channel.fileno() != -1:
            self._channel.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End the robot and wait until it is gone; does nothing the second time."""
        self.hang_up()
        with self._turn:
            self._channel.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._radio_fd is not None:
            os.close(self._radio_fd)
            self._radio_fd = None
        self._log.close()

    def _ask(self, request: Message, timeout_s: float = _REPLY_S) -> list[int]:
        deadline = Deadline.after(timeout_s)
        with self._turn:
            try:
                medium_wire.send(self._channel, request, deadline)
                received = medium_wire.receive(self._channel, deadline)
            except (OSError, ValueError) as error:
                # A late reply would be taken for the next one's.
                self._channel.close()
                raise self._gone(str(error)) from error
        if received is None:
            raise self._gone("it ended")
        reply, descriptors = received
        if "error" in reply:
            raise RobotError(reply["error"], where=self.spec.name, remedy=reply["remedy"])
        return descriptors

    def _gone(self, cause: str) -> LinkError:
        if self._log.closed:
            cause, said = "it was ended", ""
        else:
            said = os.pread(self._log.fileno(), 1 << 16, 0).decode(errors="replace").strip().rsplit("\n", 1)[-1]
        return LinkError(
            f"the emulated robot does not answer: {cause}" + (f"; it said: {said}" if said else ""),
            where=self.spec.name,
            remedy="start the lab again",
        )
