"""Persistent shells on a robot: they run commands without a new SSH session for each command.

A command is a line `NONCE VERB WORD...`, quoted as all remote commands. On both streams the shell writes the nonce,
the output of the command, and the nonce again with the exit code. If the word `held` precedes the verb, the shell
writes the end only after it has received another line. The nonce is random for each command, and programs on the
robot do not receive it. Therefore no output, with or without a newline at its end, can be mistaken for the end of an
answer, and output of processes that a command left running is dropped between two commands.
"""

import re
import secrets
import threading
from contextlib import suppress
from typing import Final, Self

from fieldkit.core.deadline import Deadline, call_with_deadline
from fieldkit.remote.link import BROKEN, Channel, Link, Transport, UnfitServerError

_READY: Final = b"ready\n"
_CHUNK: Final = 1 << 15
_NONCE_BYTES: Final = 16
_END: Final = re.compile(rb" [0-9]{1,3}\n")
_MAX_END_BYTES: Final = 5
"""Length of the longest text that `_END` matches."""
_SHELL_COUNT: Final = 2
"""Number of shells per robot: a capture and a listener start at the same time."""


class ShellPool:
    """The persistent shells of one robot, which are opened again on each link. Each shell runs one command at a time.

    If no shell is free, the caller must open a separate channel for its command.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()  # protects the attributes below
        self._link: Link | None = None
        self._shells: list[PersistentShell] = []
        self._opening = False
        self._opener: threading.Thread | None = None

    def begin(
        self,
        link: Link,
        command_line: str,
        deadline: Deadline,
        close_event: threading.Event,
        *,
        ends_on_request: bool = False,
    ) -> "RunningCommand | None":
        """Start a command in a shell on `link`; return None if no shell is free, or if the shell has ended.

        With `ends_on_request`, the shell reports the end of the command only after `RunningCommand.request_end`.

        Raises:
            ExpiredError: The deadline passed, or `close_event` was set.
            OSError, SSHException, EOFError: The connection broke.
        """
        with self._lock:
            shells = list(self._shells) if self._link is link else []
        shell = next((candidate for candidate in shells if candidate.reserve()), None)
        if shell is None:
            return None
        full_line = f"held {command_line}" if ends_on_request else command_line
        command = call_with_deadline(lambda: shell.start(full_line), deadline, close_event, what="start")
        link.acknowledge()
        return command

    def restore(self, link: Link, command: str) -> None:
        """Start to open a shell with `command` if `link` has too few shells.

        Nothing is done while another shell is being opened, or if an earlier attempt on this link has failed.
        """
        with self._lock:
            if self._link is not link:
                self._link, self._shells, self._opening = link, [], False
            self._shells = [shell for shell in self._shells if shell.alive]
            if self._opening or len(self._shells) == _SHELL_COUNT:
                return
            self._opening = True
            self._opener = threading.Thread(target=self._open, args=(link, command), daemon=True)
            self._opener.start()

    def wait_until_open(self, deadline: Deadline) -> None:
        """Wait until no shell is being opened any more, or the deadline has passed."""
        with self._lock:
            opener = self._opener
        if opener is not None:
            opener.join(deadline.remaining_s)

    def _open(self, link: Link, command: str) -> None:
        with suppress(*BROKEN):
            channel = link.open_additional()
            shell = None if channel is None else PersistentShell.open(channel, command)
            with self._lock:
                if shell is not None and self._link is link:
                    self._shells, self._opening = [*self._shells, shell], False


class PersistentShell:
    """A shell for one command at a time: `reserve` reserves it, and `RunningCommand.close` releases it.

    Args:
        channel: The channel of the shell, which has reported that it is ready.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._reservation = threading.Lock()

    @classmethod
    def open(cls, channel: Channel, command: str) -> Self:
        """Start a shell with `command` on `channel`, and return it when it is ready.

        Raises:
            EOFError: The shell did not start, or a login shell printed a greeting before it started.
            OSError, SSHException: The connection broke.
        """
        channel.exec_command(command)
        output = b""
        while len(output) < len(_READY) and (chunk := channel.recv(len(_READY) - len(output))):
            output += chunk
        if output != _READY:
            channel.close()
            raise EOFError("the persistent shell did not start")
        return cls(channel)

    @property
    def alive(self) -> bool:
        """Whether the shell is running, as far as the received data shows."""
        return not (self._channel.closed or self._channel.eof_received)

    def reserve(self) -> bool:
        """Reserve the shell for the caller; return False if it has ended or runs a command."""
        return self.alive and self._reservation.acquire(blocking=False)

    def start(self, command_line: str) -> "RunningCommand | None":
        """Start a command in a reserved shell; return None if the shell has ended.

        Raises:
            SSHException: The connection broke.
        """
        nonce = secrets.token_hex(_NONCE_BYTES).encode()
        command = None
        try:
            self._channel.settimeout(None)
            with suppress(OSError):  # the shell has ended; a lost connection is reported by the next session
                self._channel.sendall(nonce + b" " + command_line.encode() + b"\n")
            command = wait_for_start(self._channel, nonce, self._reservation)
        finally:
            if command is None:
                self._channel.close()
        return command


def wait_for_start(channel: Channel, nonce: bytes, reservation: threading.Lock) -> "RunningCommand | None":
    """Return a command when the shell has started it, or None if the shell has ended.

    Args:
        channel: The channel of the shell, to which the command was sent.
        nonce: The nonce of the command.
        reservation: The lock that reserves the shell.

    Raises:
        SSHException: The connection broke.
        UnfitServerError: The end mark has no exit code.
    """
    output = _Stream(nonce)
    while not output.has_started and (chunk := channel.recv(_CHUNK)):
        output.feed(chunk)
    return RunningCommand(channel, output, _Stream(nonce), reservation) if output.has_started else None


class RunningCommand:
    """A command in a persistent shell, with the part of a channel's interface that `drain` uses.

    Args:
        channel: The channel of the shell.
        out: Its standard output, whose start mark has arrived.
        err: Its standard error.
        reservation: The lock that reserves the shell; it is released by `close`.
    """

    def __init__(self, channel: Channel, out: "_Stream", err: "_Stream", reservation: threading.Lock) -> None:
        self._channel = channel
        self._reservation: threading.Lock | None = reservation
        self._end_event = threading.Event()
        self._out, self._err = out, err

    def __del__(self) -> None:
        """Close the command if it was not closed, as a channel does."""
        self.close()

    def request_end(self) -> None:
        """Request the end of a command that was started with `ends_on_request`.

        Raises:
            OSError, SSHException: The connection broke.
        """
        self._channel.sendall(b"\n")

    @property
    def eof_received(self) -> bool:
        """Whether no more output of the command can arrive; reads the available data of both streams."""
        if self._channel.recv_ready():
            self._out.feed(self._channel.recv(_CHUNK))
        if self._channel.recv_stderr_ready():
            self._err.feed(self._channel.recv_stderr(_CHUNK))
        return self._has_ended or self._is_cut_off

    @property
    def status_event(self) -> threading.Event:
        """An event that is set when the exit code is known, or cannot become known."""
        return self._end_event if self._has_ended else self._channel.status_event

    def fileno(self) -> int:
        """Return a descriptor that is readable when data have arrived that `eof_received` has not read."""
        return self._channel.fileno()

    def get_transport(self) -> Transport:
        """Return the transport of the shell's channel."""
        return self._channel.get_transport()

    def settimeout(self, seconds: float | None) -> None:
        """Set the timeout of `recv`."""
        self._channel.settimeout(seconds)

    def recv_ready(self) -> bool:
        """Return True if standard output of the command is available."""
        return bool(self._out.output)

    def recv_stderr_ready(self) -> bool:
        """Return True if standard error of the command is available."""
        return bool(self._err.output)

    def recv(self, size_bytes: int) -> bytes:
        """Wait for standard output and return at most `size_bytes` of it; empty at its end.

        Raises:
            TimeoutError: Nothing arrived in time.
        """
        while self._out.is_waiting and (chunk := self._channel.recv(_CHUNK)):
            self._out.feed(chunk)
        # At the end of standard output, the end mark on standard error has not necessarily arrived.
        while not self._out.output and self._err.code is None and (chunk := self._channel.recv_stderr(_CHUNK)):
            self._err.feed(chunk)
        return self._out.read(size_bytes)

    def recv_stderr(self, size_bytes: int) -> bytes:
        """Return at most `size_bytes` of the available standard error."""
        return self._err.read(size_bytes)

    def recv_exit_status(self) -> int:
        """Return the exit code, or -1 if a signal terminated the shell or the connection broke.

        Raises:
            EOFError: The shell has exited before the command.
        """
        if self._out.code is not None:
            return self._out.code
        if self._channel.recv_exit_status() >= 0:
            raise EOFError("its shell ended before the command")
        return -1

    def close(self) -> None:
        """Release the shell if the command has ended; otherwise close the shell."""
        reservation, self._reservation = self._reservation, None
        if not self._has_ended:
            self._channel.close()
        elif reservation is not None:
            reservation.release()

    @property
    def _has_ended(self) -> bool:
        if self._out.code is not None and self._err.code is not None:
            self._end_event.set()
        return self._end_event.is_set()

    @property
    def _is_cut_off(self) -> bool:
        """Whether the channel has ended, and all received data have been read."""
        has_channel_ended = self._channel.closed or self._channel.eof_received
        return bool(has_channel_ended) and not (self._channel.recv_ready() or self._channel.recv_stderr_ready())


Execution = Channel | RunningCommand
"""A running command: in a separate session, or in a persistent shell, which provides no standard input."""


class _Stream:
    """Extracts the output of a command from one stream, between the marks at its start and at its end.

    Args:
        nonce: The text of both marks.

    Attributes:
        has_started: Whether the start mark has arrived.
        output: Unread output of the command.
        code: Exit code of the command; None before the end mark has arrived.
    """

    def __init__(self, nonce: bytes) -> None:
        self.has_started = False
        self.output = b""
        self.code: int | None = None
        self._nonce = nonce
        self._incomplete = b""

    @property
    def is_waiting(self) -> bool:
        """Whether there is no unread output, and the end mark has not arrived."""
        return not self.output and self.code is None

    def read(self, size_bytes: int) -> bytes:
        """Remove and return at most `size_bytes` of the unread output."""
        chunk, self.output = self.output[:size_bytes], self.output[size_bytes:]
        return chunk

    def feed(self, chunk: bytes) -> None:
        """Process received data; data before the start mark and after the end mark are dropped.

        Raises:
            UnfitServerError: The end mark has no exit code.
        """
        if self.code is not None:
            return
        data, self._incomplete = self._incomplete + chunk, b""
        if not self.has_started:
            before_start, start_mark, data = data.partition(self._nonce + b"\n")
            self.has_started = bool(start_mark)
            if not start_mark:
                self._incomplete = before_start[-len(self._nonce) :]
                return
        output, nonce, after_nonce = data.partition(self._nonce)
        if nonce:
            self._incomplete = nonce + after_nonce
            if _END.match(after_nonce):
                self.code = int(after_nonce.partition(b"\n")[0])
            elif len(after_nonce) >= _MAX_END_BYTES:
                raise UnfitServerError("the answer to a command has no valid exit code")
        else:
            # Only a possible start of the nonce is kept, because a caller may wait for the output before it.
            partial_bytes = next(
                (n for n in range(len(self._nonce) - 1, 0, -1) if output.endswith(self._nonce[:n])), 0
            )
            output, self._incomplete = output[: len(output) - partial_bytes], output[len(output) - partial_bytes :]
        self.output += output
