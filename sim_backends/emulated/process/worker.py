"""Worker processes of the lab: their interpreter, their messages, and their start and stop."""

import array
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, RobotError, TestbedLostError

PROJECT: Final = Path(__file__).resolve().parents[3]
"""Folder from which Python imports this package."""


def command(module: str) -> list[str]:
    """Return the command that runs a module of this package. The caller must set `PYTHONPATH` to `PROJECT`.

    Neither the working directory nor the user's site-packages can shadow modules of this package.
    """
    return [sys.executable, "-P", "-s", "-m", module]


LINE_LIMIT_BYTES: Final = 8 << 20
"""Maximum length of a message, which is one line of JSON."""
DESCRIPTORS: Final = 4
"""Maximum number of file descriptors in one message."""

Message = dict[str, Any]


def send(channel: socket.socket, message: Message, deadline: Deadline, descriptors: Sequence[int] = ()) -> None:
    """Send one message, with copies of file descriptors.

    Raises:
        OSError: The peer has closed the socket, or did not receive the message before the deadline.
        ValueError: The message is longer than `LINE_LIMIT_BYTES`.
    """
    line = json.dumps(message).encode() + b"\n"
    if len(line) > LINE_LIMIT_BYTES:
        raise ValueError(f"a message of {len(line)} bytes is longer than {LINE_LIMIT_BYTES}")
    rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", descriptors))] if descriptors else []
    channel.settimeout(deadline.remaining_s)
    sent_bytes = channel.sendmsg([line], rights)
    channel.settimeout(deadline.remaining_s)
    channel.sendall(line[sent_bytes:])


def receive(channel: socket.socket, deadline: Deadline) -> tuple[Message, list[int]] | None:
    """Return the next message and its file descriptors, or None if the peer closed the socket before it was complete.

    Raises:
        OSError: The message was not complete by the deadline, or the connection broke.
        ValueError: The line is too long or not JSON.
    """
    line = bytearray()
    descriptors: list[int] = []
    while not line.endswith(b"\n"):
        channel.settimeout(deadline.remaining_s)
        data, new_descriptors, _, _ = socket.recv_fds(channel, 1 << 16, DESCRIPTORS, socket.MSG_CMSG_CLOEXEC)
        descriptors += new_descriptors
        if not data:
            return None
        line += data
        if len(line) > LINE_LIMIT_BYTES:
            raise ValueError(f"a message is longer than {LINE_LIMIT_BYTES} bytes")
    message: Message = json.loads(line)
    return message, descriptors


REPLY_S: Final = 15.0
"""Minimum time that a request waits for its reply."""

_EXIT_S: Final = 5.0
"""Time for a process to exit at a request before it is killed."""
_EXIT_STATUS_S: Final = 5.0
"""Maximum time after a process has closed its descriptors until its exit status is available."""
_EXITED: Final = "it exited"
PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class Worker:
    """Process that runs a module of this package and serves requests over a socket pair.

    The worker process exits when this object is closed. It also exits when the process that created this object exits
    for any reason: the control socket closes, and the kernel kills the worker when the thread that created this
    object ends. Create it in a thread that exists as long as the lab. The methods may be called from any thread.

    Args:
        name: Name for messages.
        module: The module; its arguments are the descriptor number of its socket, then `words`.
        words: Further arguments of the module.
        descriptors: Descriptors of this process that the worker process inherits, with the same numbers.
        command_prefix: Command prefix that runs the interpreter, for example `unshare ... --`.
        home: Value of `HOME`.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(
        self,
        name: str,
        module: str,
        *,
        words: Sequence[str] = (),
        descriptors: Sequence[int] = (),
        command_prefix: Sequence[str] = (),
        home: str = "/",
    ) -> None:
        self.name = name
        self._lock = threading.Lock()
        self._channel, worker_end = socket.socketpair()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (open while the process runs; `close` closes it)
        python = command(module)
        argv = ["setpriv", "--pdeathsig", "KILL", "--", *command_prefix, *python, str(worker_end.fileno()), *words]
        try:
            self._process = subprocess.Popen(
                argv,
                pass_fds=[worker_end.fileno(), *descriptors],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                # Ctrl-C in a terminal reaches the whole group, but the lab stops its processes itself.
                start_new_session=True,
                env={
                    "PATH": PATH,
                    "HOME": home,
                    "LANG": "C.UTF-8",
                    "PYTHONPATH": str(PROJECT),
                    "OPENBLAS_NUM_THREADS": "1",  # numpy would start a busy thread per core
                },
                cwd="/",
            )
        except OSError as error:
            self._channel.close()
            self._log.close()
            raise ConfigurationError(f"cannot start {name}: {error}", remedy="apt-get install util-linux") from error
        finally:
            worker_end.close()

    @property
    def pid(self) -> int:
        """Process id of the outermost process; when it exits, all its descendants exit."""
        return self._process.pid

    def request(
        self, message: Message, *, descriptors: Sequence[int] = (), timeout_s: float = REPLY_S
    ) -> tuple[Message, list[int]]:
        """Send a request; return the reply and its file descriptors, which the caller must close.

        Raises:
            LinkError: The process is busy with another request.
            RobotError: The reply is an error.
            TestbedLostError: The process has exited or did not answer in time; it can no longer be used.
        """
        if not self._lock.acquire(timeout=timeout_s):
            raise LinkError("is busy with another request", where=self.name, remedy="try again")
        # The wait is never shorter than REPLY_S, because a late reply would be read as the reply to the next request.
        deadline = Deadline.after(max(timeout_s, REPLY_S))
        try:
            send(self._channel, message, deadline, descriptors)
            answer = receive(self._channel, deadline)
        except (OSError, ValueError) as error:
            self._channel.close()
            raise self._exit_error(_EXITED if isinstance(error, ConnectionError) else str(error)) from error
        finally:
            self._lock.release()
        if answer is None:
            raise self._exit_error(_EXITED)
        reply, _ = answer
        if "error" in reply:
            raise RobotError(reply["error"], where=self.name, remedy=reply.get("remedy", ""))
        return answer

    def check_alive(self) -> None:
        """Check that the process can serve requests.

        Raises:
            TestbedLostError: The process has exited, or did not answer a request in time.
        """
        if self._channel.fileno() == -1 or self._process.poll() is not None:
            raise self._exit_error(_EXITED)

    def request_exit(self) -> None:
        """Request that the process exits, without waiting for it; pending requests fail immediately."""
        if self._channel.fileno() != -1:
            self._channel.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Stop the process and wait until it has exited; a second call does nothing."""
        self.request_exit()
        with self._lock:
            self._channel.close()
        try:
            self._process.wait(_EXIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()

    def _exit_error(self, cause: str) -> TestbedLostError:
        """Return the error for a process that does not answer.

        It has the signal that killed the process, if any, and the last line of its output.
        """
        if self._log.closed:
            cause, last_line = "it was stopped", ""
        else:
            last_line = last_line_of(self._log.fileno())
        with suppress(subprocess.TimeoutExpired):
            if (code := self._process.wait(_EXIT_STATUS_S if cause == _EXITED else 0)) < 0:
                cause = f"it was killed by {signal.Signals(-code).name}"
        return TestbedLostError(
            f"does not answer: {cause}" + (f"; its last output: {last_line}" if last_line else ""),
            where=f"{self.name}, pid {self.pid}",
            remedy="start it again: a trial by fieldkit resume TRIAL, a campaign by its command, a lab by "
            "fieldkit lab down and fieldkit lab up",
        )


def last_line_of(fd: int) -> str:
    """Return the last line that is not empty in the last 64 KiB of a file; "" if there is no such line."""
    tail = os.pread(fd, 1 << 16, max(os.fstat(fd).st_size - (1 << 16), 0))
    return tail.decode(errors="replace").strip().rsplit("\n", 1)[-1]
