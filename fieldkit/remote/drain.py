"""Wait for output of a remote command, or for its end, with a deadline. Both output streams are read."""

import select
import time
from typing import IO, Final

from fieldkit.core.deadline import Deadline, ExpiredError
from fieldkit.core.errors import RobotError
from fieldkit.remote.command import printable
from fieldkit.remote.link import Channel, connection_error
from fieldkit.remote.persistent_shells import Execution

_CHUNK: Final = 1 << 16
_MAX_WAIT_S: Final = 1.0
"""Maximum time of one wait. If Ctrl-C arrives just before a wait, Python handles it only after the wait."""


def wait_for_output(channel: Execution, expected: bytes, *, deadline: Deadline, robot: str) -> bool:
    """Wait until the command has written as many bytes as `expected` has; return False if it ended earlier.

    Raises:
        ExpiredError, EOFError, OSError, SSHException, RobotError: For the same reasons as `drain`.
    """
    remaining_bytes = len(expected)
    while remaining_bytes and not deadline.expired:
        start_s, wait_s = time.monotonic(), min(deadline.remaining_s, _MAX_WAIT_S)
        channel.settimeout(wait_s)
        try:
            # `select` would also report standard error, which only `drain` reads.
            chunk = channel.recv(remaining_bytes)
        except TimeoutError:
            deadline = deadline.extended_by_suspension(start_s, wait_s)
            continue
        remaining_bytes -= len(chunk)
        if not chunk:
            if not channel.status_event.wait(deadline.remaining_s):
                break
            _exit_code(channel, b"", robot)  # raises an error if the connection has ended, too
            return False
    if remaining_bytes:
        raise ExpiredError("report")
    return True


def drain(
    channel: Execution, out: IO[bytes], *, stdin: bytes | None, deadline: Deadline, limit_bytes: int, robot: str
) -> tuple[int, bytes]:
    """Send `stdin`, write standard output to `out`, and return the exit code and the end of standard error.

    If `stdin` is None, nothing is sent, and standard input is not closed. A command in a persistent shell has no
    standard input: `stdin` must be None.

    Raises:
        ExpiredError: The deadline passed.
        EOFError, OSError, SSHException: The connection ended before the command.
        RobotError: There was more output than `limit_bytes`, or a signal terminated the command.
    """
    stderr = bytearray()
    received_bytes = 0
    pending = None if stdin is None else memoryview(stdin)
    while not deadline.expired:
        if isinstance(channel, Channel):
            pending = _feed(channel, pending)
        is_at_end = _is_at_end(channel)  # before the buffers are read, so that no output is missed
        # One chunk of each stream per iteration, so that limit and deadline apply to a sender that never pauses.
        if channel.recv_ready():
            received_bytes += out.write(channel.recv(_CHUNK))
        if received_bytes > limit_bytes:
            raise RobotError(f"sent more than {limit_bytes} bytes", where=robot, remedy="check what it sends")
        if channel.recv_stderr_ready():
            stderr += channel.recv_stderr(_CHUNK)
            del stderr[:-_CHUNK]
        if is_at_end and not (channel.recv_ready() or channel.recv_stderr_ready()):
            # recv_exit_status has no timeout (paramiko/paramiko#1815), but its event has one.
            if not channel.status_event.wait(deadline.remaining_s):
                break
            return _exit_code(channel, bytes(stderr), robot), bytes(stderr)
        # The descriptor reports input on both streams and their end, but not whether sending is possible.
        start_s, wait_s = time.monotonic(), min(deadline.remaining_s, _MAX_WAIT_S if pending is None else 0.01)
        select.select([channel.fileno()], [], [], wait_s)
        deadline = deadline.extended_by_suspension(start_s, wait_s)
    raise ExpiredError("end")


def _is_at_end(channel: Execution) -> bool:
    return bool(channel.eof_received or (isinstance(channel, Channel) and channel.closed))


def _feed(channel: Channel, pending: memoryview | None) -> memoryview | None:
    """Send as much of `pending` as the channel accepts, and return the rest.

    When all is sent, standard input is closed, and the rest is None. If `pending` is None, nothing is done.
    """
    while pending and channel.send_ready():
        pending = pending[channel.send(pending[:_CHUNK].tobytes()) :]
    if pending is not None and not pending:
        channel.shutdown_write()
        return None
    return pending


def _exit_code(channel: Execution, stderr: bytes, robot: str) -> int:
    code = channel.recv_exit_status()
    if code >= 0:
        return code
    if (error := connection_error(channel.get_transport())) is not None:
        raise error
    raise RobotError(
        f"a signal ended the command: {printable(stderr) or 'no message'}",
        where=robot,
        remedy="on the robot: dmesg | tail; did it run out of memory or shut down?",
    )
