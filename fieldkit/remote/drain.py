"""Waiting for a remote command, for what it says first and for its end: both streams read, a deadline on all."""

import select
import time
from typing import IO, Final

from fieldkit.core.deadline import Deadline, ExpiredError
from fieldkit.core.errors import RobotError
from fieldkit.remote.command import printable
from fieldkit.remote.link import Channel
from fieldkit.remote.standing import Running

_CHUNK: Final = 1 << 16
_LINK_END_S: Final = 0.5
_WAKE_S: Final = 1.0
"""Python sees a Ctrl-C that came just before it blocked only when it wakes."""


def hear(channel: Running, words: bytes, *, deadline: Deadline, robot: str) -> bool:
    """Return whether the command has written as much as `words` to standard output; false if it ended without.

    Raises:
        ExpiredError, EOFError, RobotError: As `drain`.
    """
    left = len(words)
    while left and not deadline.expired:
        began_s, wait_s = time.monotonic(), min(deadline.remaining_s, _WAKE_S)
        channel.settimeout(wait_s)
        try:
            piece = channel.recv(left)  # the descriptor would report standard error too, which `drain` reads
        except TimeoutError:
            deadline = deadline.after_wait(began_s, wait_s)
            continue
        left -= len(piece)
        if not piece:
            if not channel.status_event.wait(deadline.remaining_s):
                break
            _exit_code(channel, b"", robot)  # which tells the end of a link from the command's
            return False
    if left:
        raise ExpiredError("report")
    return True


def drain(
    channel: Running, out: IO[bytes], *, stdin: bytes | None, deadline: Deadline, limit_bytes: int, robot: str
) -> tuple[int, bytes]:
    """Feed `stdin`, write standard output to `out`, and return the exit code and the end of standard error.

    With `stdin` None nothing is sent, not even the end of it.

    Raises:
        ExpiredError: The deadline passed.
        EOFError, OSError, SSHException: The connection ended before the command.
        RobotError: There was more output than `limit_bytes`, or a signal ended the command.
    """
    stderr = bytearray()
    received = 0
    feed = None if stdin is None else memoryview(stdin)
    while not deadline.expired:
        if isinstance(channel, Channel):
            feed = _feed(channel, feed)
        ended = channel.eof_received or channel.closed  # read before the buffers, so that none is left
        # A piece of each per round: a sender that never pauses must meet its limit and the deadline.
        if channel.recv_ready():
            received += out.write(channel.recv(_CHUNK))
        if received > limit_bytes:
            raise RobotError(f"sent more than {limit_bytes} bytes", where=robot, remedy="check what it sends")
        if channel.recv_stderr_ready():
            stderr += channel.recv_stderr(_CHUNK)
            del stderr[:-_CHUNK]
        if ended and not (channel.recv_ready() or channel.recv_stderr_ready()):
            # recv_exit_status has no time-out (paramiko/paramiko#1815), its event has.
            if not channel.status_event.wait(deadline.remaining_s):
                break
            return _exit_code(channel, bytes(stderr), robot), bytes(stderr)
        # The descriptor reports both streams and their end, but not room to send.
        began_s, wait_s = time.monotonic(), min(deadline.remaining_s, _WAKE_S if feed is None else 0.01)
        select.select([channel.fileno()], [], [], wait_s)
        deadline = deadline.after_wait(began_s, wait_s)
    raise ExpiredError("end")


def _feed(channel: Channel, pending: memoryview | None) -> memoryview | None:
    """Send what the channel takes of `pending`; at its end close standard input and return None."""
    while pending and channel.send_ready():
        pending = pending[channel.send(pending[:_CHUNK].tobytes()) :]
    if pending is not None and not pending:
        channel.shutdown_write()
        return None
    return pending


def _exit_code(channel: Running, stderr: bytes, robot: str) -> int:
    code = channel.recv_exit_status()
    if code >= 0:
        return code
    # A link that breaks closes its channels first and says so itself a little later.
    transport = channel.get_transport()
    transport.join(_LINK_END_S)
    if not transport.is_active():
        raise transport.get_exception() or EOFError("the connection ended before the command")
    raise RobotError(
        f"a signal ended the command: {printable(stderr) or 'no message'}",
        where=robot,
        remedy="on the robot: dmesg | tail; was memory short, or did it shut down?",
    )
