"""Worker processes of the lab: each ends with its owner, however that ends, and serves one request at a time."""

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
"""From when a process has closed its descriptors until it can be waited for."""
_ENDED: Final = "it ended"
PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


class Worker:
    """Runs a module of this package with one end of a socket pair; use as a context manager.

    The process ends with this object, and with this one's process however that ends: the control socket closes, and
    the kernel kills it with the thread that made this object. So make it in a thread that lives as long as the lab.
    The methods may be called from any thread.

    Args:
        name: What it is, for messages.
        module: The module; it gets the number of its socket's descriptor, then `words`.
        words: More arguments.
        within: Command that runs the module's interpreter, for example `unshare ... --`.
        home: Its `HOME`.

    Raises:
        ConfigurationError: A program of util-linux is missing.
    """

    def __init__(
        self, name: str, module: str, *, words: Sequence[str] = (), within: Sequence[str] = (), home: str = "/"
    ) -> None:
        self.name = name
        self._turn = threading.Lock()
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
                # Ctrl-C in a terminal reaches the whole group; the lab decides when its processes end.
                start_new_session=True,
                env={
                    "PATH": PATH,
                    "HOME": home,
                    "LANG": "C.UTF-8",
                    "PYTHONPATH": str(interpreter.PROJECT),
                    "OPENBLAS_NUM_THREADS": "1",  # numpy starts a thread per core, and each spins for a while
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
        """Process id of the outermost process, whose end is the end of all of it."""
        return self._process.pid

    def ask(
        self, request: Message, *, descriptors: Sequence[int] = (), timeout_s: float = REPLY_S
    ) -> tuple[Message, list[int]]:
        """Send a request; return the reply and the descriptors that came with it, the caller's to close.

        Raises:
            LinkError: It is busy.
            RobotError: It answered that it could not.
            TestbedLostError: It ended or did not answer in time; it answers nobody any more.
        """
        if not self._turn.acquire(timeout=timeout_s):
            raise LinkError("is busy with another request", where=self.name, remedy="try again")
        # Whoever is in a hurry must not break it for the others: a late reply would be taken for the next one's.
        deadline = Deadline.after(max(timeout_s, REPLY_S))
        try:
            ipc.send(self._channel, request, deadline, descriptors)
            received = ipc.receive(self._channel, deadline)
        except (OSError, ValueError) as error:
            self._channel.close()
            raise self._gone(_ENDED if isinstance(error, ConnectionError) else str(error)) from error
        finally:
            self._turn.release()
        if received is None:
            raise self._gone(_ENDED)
        reply, _ = received
        if "error" in reply:
            raise RobotError(reply["error"], where=self.name, remedy=reply.get("remedy", ""))
        return received

    def demand_up(self) -> None:
        """Return if it runs.

        Raises:
            TestbedLostError: It ended, or did not answer a request in time.
        """
        if self._channel.fileno() == -1 or self._process.poll() is not None:
            raise self._gone(_ENDED)

    def hang_up(self) -> None:
        """Let it end, without waiting for it; requests under way fail at once."""
        if self._channel.fileno() != -1:
            self._channel.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End it and wait until it is gone; does nothing the second time."""
        self.hang_up()
        with self._turn:
            self._channel.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()

    def _gone(self, cause: str) -> TestbedLostError:
        if self._log.closed:
            cause, said = "it was ended", ""
        else:
            said = os.pread(self._log.fileno(), 1 << 16, 0).decode(errors="replace").strip().rsplit("\n", 1)[-1]
        with suppress(subprocess.TimeoutExpired):
            if (code := self._process.wait(_ENDING_S if cause == _ENDED else 0)) < 0:
                cause = f"it was killed by {signal.Signals(-code).name}"
        return TestbedLostError(
            f"does not answer: {cause}" + (f"; it said: {said}" if said else ""),
            where=f"{self.name}, pid {self.pid}",
            remedy="start it again: a trial by fieldkit resume TRIAL, a campaign by its command, a lab by "
            "fieldkit lab down and fieldkit lab up",
        )
