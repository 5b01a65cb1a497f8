"""Federates that are child processes, with the protocol on their standard input and output."""

import os
import shlex
import signal
import subprocess
import tempfile
import time
import weakref
from contextlib import suppress
from typing import IO, Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.federates.channels import StreamChannel

_EXIT_S: Final = 1.0
"""Time for a process to exit after its input was closed, and again after SIGTERM."""
_POLL_S: Final = 0.005
"""Polling interval while waiting for the exit of the process."""
_SHOWN_BYTES: Final = 4096
"""Largest number of bytes of standard error that are read for a message."""
_SHOWN_LINES: Final = 10
"""Largest number of lines that are shown: enough for the cause of an error in a stack trace."""
_NOTE: Final = "note: "


class Child:
    """A federate that is a child process.

    It runs in a separate session, so that Ctrl-C does not terminate it during a request. It is terminated when
    `close` is called, when this object is garbage collected, or when this process exits.

    Args:
        command: Its command line; it is split as by a shell, but no shell runs.

    Attributes:
        channel: The channel to it.
        pid: Its process id.

    Raises:
        ConfigurationError: The process cannot be started.
    """

    def __init__(self, command: str) -> None:
        try:
            words = shlex.split(command)
        except ValueError as error:
            raise ConfigurationError(f"{command!r} is not a command: {error}") from error
        if not words:
            raise ConfigurationError("the command of a federate is empty")
        # Standard error is a file. A pipe that is not read would block a federate that writes much.
        self._stderr: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed with the process)
        try:
            process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._stderr, start_new_session=True
            )
        except OSError as error:
            self._stderr.close()
            raise ConfigurationError(
                f"the federate {words[0]} cannot be started: {error.strerror}",
                remedy="check the command and its path",
            ) from error
        assert process.stdin is not None
        assert process.stdout is not None
        self._process = process
        self.pid = process.pid
        # The channel gets duplicates, so that only the channel closes its descriptors. If the process object closed
        # them later, the same numbers might already be in use for other files.
        self.channel = StreamChannel(os.dup(process.stdout.fileno()), os.dup(process.stdin.fileno()))
        process.stdin.close()
        process.stdout.close()
        self._finalizer = weakref.finalize(self, _terminate, process, self.channel, self._stderr)

    @property
    def last_output(self) -> list[str]:
        """The last lines that it wrote to its standard error, at most ten, without empty ones; none after `close`."""
        if self._stderr.closed:
            return []
        size = os.fstat(self._stderr.fileno()).st_size
        tail = os.pread(self._stderr.fileno(), _SHOWN_BYTES, max(size - _SHOWN_BYTES, 0)).decode(errors="replace")
        return [line.rstrip() for line in tail.splitlines() if line.strip()][-_SHOWN_LINES:]

    def first_notes(self) -> list[str]:
        """Return the texts of the first lines `note: TEXT` of its standard error, at most ten.

        Only the first 4096 bytes are searched.
        """
        head = os.pread(self._stderr.fileno(), _SHOWN_BYTES, 0).decode(errors="replace")
        notes = [line.removeprefix(_NOTE) for line in head.splitlines() if line.startswith(_NOTE)]
        return notes[:_SHOWN_LINES]

    def exit_text(self, wait_s: float = 0.5) -> str:
        """Return a text about its exit, such as `it has exited with code 1`; empty if it does not exit in time."""
        deadline_s = time.monotonic() + wait_s
        while not _has_exited(self._process.pid):
            if time.monotonic() > deadline_s:
                return ""
            time.sleep(_POLL_S)
        try:
            info = os.waitid(os.P_PID, self._process.pid, os.WEXITED | os.WNOWAIT)
        except ChildProcessError:
            info = None
        if info is None or info.si_code == os.CLD_EXITED:
            return "it has exited" if info is None else f"it has exited with code {info.si_status}"
        return f"it was terminated by {signal.Signals(info.si_status).name}"

    def kill(self) -> None:
        """Kill the process immediately."""
        if self._finalizer.alive:
            _signal_group(self._process.pid, signal.SIGKILL)
        self._finalizer()

    def close(self) -> None:
        """Close the channel, and terminate the process and all other processes of its process group."""
        self._finalizer()


def _has_exited(pid: int) -> bool:
    """Return True if a child has exited; it stays a zombie, so that its process id is not used again.

    If this process ignores SIGCHLD, the kernel has removed the zombie.
    """
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None
    except ChildProcessError:
        return True


def _terminate(process: "subprocess.Popen[bytes]", channel: StreamChannel, stderr: IO[bytes]) -> None:
    channel.close()
    # A federate must exit when its standard input is closed; SIGTERM is sent only if it does not.
    for signal_number in (None, signal.SIGTERM):
        if signal_number is not None:
            _signal_group(process.pid, signal_number)
        deadline_s = time.monotonic() + _EXIT_S
        while time.monotonic() < deadline_s and not _has_exited(process.pid):
            time.sleep(_POLL_S)
        if _has_exited(process.pid):
            break
    # SIGKILL to the group also terminates processes that the command started, and suspended processes.
    _signal_group(process.pid, signal.SIGKILL)
    process.wait()
    stderr.close()


def _signal_group(pid: int, signal_number: signal.Signals) -> None:
    with suppress(ProcessLookupError, PermissionError):  # only the zombie remains
        os.killpg(pid, signal_number)
