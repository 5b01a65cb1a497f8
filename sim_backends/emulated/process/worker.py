"""Worker processes of the lab: each serves one request at a time and stops with the process that started it."""

import os
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import ConfigurationError, LinkError, RobotError, TestbedLostError
from sim_backends.emulated.process import interpreter, ipc
from sim_backends.emulated.process.ipc import Message

REPLY_S: Final = 15.0

_END_S: Final = 2.0
_ENDING_S: Final = 0.5
"""Time from when a process has closed its descriptors until its exit status is available."""
_ENDED: Final = "it exited"
PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class Worker:
    """Process that runs a module of this package and serves requests over a socket pair.

    The process exits when this object is closed or this process exits for any reason: the control socket closes, and
    the kernel kills the process when the thread that made this object ends. So make it in a thread that lives as long
    as the lab. The methods may be called from any thread.

    Args:
        name: Name for messages.
        module: The module; its arguments are the descriptor number of its socket, then `words`.
        words: More arguments.
        within: Command prefix that runs the interpreter, for example `unshare ... --`.
        home: Value of `HOME`.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(
        self, name: str, module: str, *, words: Sequence[str] = (), within: Sequence[str] = (), home: str = "/"
    ) -> None:
        self.name = name
        self._lock = threading.Lock()
        self._channel, theirs = socket.socketpair()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as the process; `close` closes it)
        python = interpreter.command(module)
        argv = ["setpriv", "--pdeathsig", "KILL", "--", *within, *python, str(theirs.fileno()), *words]
        try:
            self._process = subprocess.Popen(
                argv,
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                # Ctrl-C in a terminal reaches the whole group, but the lab stops its processes itself.
                start_new_session=True,
                env={
                    "PATH": PATH,
                    "HOME": home,
                    "LANG": "C.UTF-8",
                    "PYTHONPATH": str(interpreter.PROJECT),
                    "OPENBLAS_NUM_THREADS": "1",  # numpy would start a busy thread per core
                },
                cwd="/",
            )
        except OSError as error:
            self._channel.close()
            self._log.close()
            raise ConfigurationError(f"cannot start {name}: {error}", remedy="apt-get install util-linux") from error
        finally:
            theirs.close()

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
        # The wait is never shorter than REPLY_S: a late reply would be taken for the reply to the next request.
        deadline = Deadline.after(max(timeout_s, REPLY_S))
        try:
            ipc.send(self._channel, message, deadline, descriptors)
            received = ipc.receive(self._channel, deadline)
        except (OSError, ValueError) as error:
            self._channel.close()
            raise self._gone(_ENDED if isinstance(error, ConnectionError) else str(error)) from error
        finally:
            self._lock.release()
        if received is None:
            raise self._gone(_ENDED)
        reply, _ = received
        if "error" in reply:
            raise RobotError(reply["error"], where=self.name, remedy=reply.get("remedy", ""))
        return received

    def check_alive(self) -> None:
        """Raise if the process cannot serve requests.

        Raises:
            TestbedLostError: It has exited, or did not answer a request in time.
        """
        if self._channel.fileno() == -1 or self._process.poll() is not None:
            raise self._gone(_ENDED)

    def hang_up(self) -> None:
        """Request that the process exits, without waiting for it; requests under way fail immediately."""
        if self._channel.fileno() != -1:
            self._channel.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Stop the process and wait until it has exited; a second call does nothing."""
        self.hang_up()
        with self._lock:
            self._channel.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()

    def _gone(self, cause: str) -> TestbedLostError:
        if self._log.closed:
            cause, last_line = "it was stopped", ""
        else:
            last_line = os.pread(self._log.fileno(), 1 << 16, 0).decode(errors="replace").strip().rsplit("\n", 1)[-1]
        with suppress(subprocess.TimeoutExpired):
            if (code := self._process.wait(_ENDING_S if cause == _ENDED else 0)) < 0:
                cause = f"it was killed by {signal.Signals(-code).name}"
        return TestbedLostError(
            f"does not answer: {cause}" + (f"; its last output: {last_line}" if last_line else ""),
            where=f"{self.name}, pid {self.pid}",
            remedy="start it again: a trial by fieldkit resume TRIAL, a campaign by its command, a lab by "
            "fieldkit lab down and fieldkit lab up",
        )
