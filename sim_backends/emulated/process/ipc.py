"""Messages between the lab and its processes over a socket pair: one JSON line per request and one per reply."""

import array
import json
import socket
from collections.abc import Sequence
from typing import Any, Final

from fieldkit.core.deadline import Deadline

LINE_LIMIT_BYTES: Final = 8 << 20
DESCRIPTORS: Final = 2
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
    sent = channel.sendmsg([line], rights)
    channel.settimeout(deadline.remaining_s)
    channel.sendall(line[sent:])


def receive(channel: socket.socket, deadline: Deadline) -> tuple[Message, list[int]] | None:
    """Return the next message and its file descriptors, or None if the peer has closed the socket.

    Raises:
        OSError: The message was not complete by the deadline, or the connection broke.
        ValueError: The line is too long or not JSON.
    """
    line = bytearray()
    descriptors: list[int] = []
    while not line.endswith(b"\n"):
        channel.settimeout(deadline.remaining_s)
        data, received, _, _ = socket.recv_fds(channel, 1 << 16, DESCRIPTORS, socket.MSG_CMSG_CLOEXEC)
        descriptors += received
        if not data:
            return None
        line += data
        if len(line) > LINE_LIMIT_BYTES:
            raise ValueError(f"a message is longer than {LINE_LIMIT_BYTES} bytes")
    message: Message = json.loads(line)
    return message, descriptors
