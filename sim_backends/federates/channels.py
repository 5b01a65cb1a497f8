"""Channels between coordinator and federate: byte streams that carry frames, with a deadline for every wait."""

import os
import select
import socket
import time
from typing import Final, Protocol

from sim_backends.federates.frames import HEADER_BYTES, MAX_FRAME_BYTES, ProtocolFrame, read_header

_CHUNK_BYTES: Final = 1 << 16
"""Largest number of bytes that one call reads."""


class ClosedError(ConnectionError):
    """The channel is closed, by the other side or by this one."""


class DeadlineError(TimeoutError):
    """A wait reached its deadline."""


class FrameChannel(Protocol):
    """A connection that carries frames, the messages of the protocol."""

    def send(self, frame: bytes, deadline_s: float | None) -> None:
        """Send a frame.

        Args:
            frame: The frame.
            deadline_s: Time of `time.monotonic` until which to wait; None for no deadline.

        Raises:
            ClosedError: The channel is closed.
            DeadlineError: The other side did not read in time.
        """
        ...

    def receive(self, deadline_s: float | None, max_bytes: int = MAX_FRAME_BYTES) -> ProtocolFrame:
        """Return the next frame.

        Args:
            deadline_s: Time of `time.monotonic` until which to wait; None for no deadline.
            max_bytes: Largest allowed size of a body.

        Raises:
            ClosedError: The channel is closed.
            DeadlineError: No complete frame arrived before the deadline.
            MalformedFrameError: The header is malformed.
        """
        ...

    def close(self) -> None:
        """Close the channel; a second call has no effect."""
        ...


class StreamChannel:
    """A channel over file descriptors: two pipes, or a socket.

    Memory for a frame is allocated while its bytes arrive, so a large size in a header does not allocate memory.

    Args:
        read_fd: Descriptor to read from.
        write_fd: Descriptor to write to; it may be the same.
    """

    def __init__(self, read_fd: int, write_fd: int) -> None:
        self._fds = {read_fd, write_fd}
        self._read_fd, self._write_fd = read_fd, write_fd
        for fd in self._fds:
            os.set_blocking(fd, False)
        self._readable = select.poll()
        self._readable.register(read_fd, select.POLLIN)
        self._writable = select.poll()
        self._writable.register(write_fd, select.POLLOUT)
        self._data = b""

    def send(self, frame: bytes, deadline_s: float | None) -> None:
        """Implement `FrameChannel.send`."""
        self._require_open()
        unsent: bytes | memoryview = frame
        while True:
            try:
                written_bytes = os.write(self._write_fd, unsent)
            except BlockingIOError:
                _wait(self._writable, deadline_s)
                continue
            except OSError as error:
                raise ClosedError("the connection was closed") from error
            if written_bytes == len(unsent):
                return
            unsent = memoryview(unsent)[written_bytes:]

    def receive(self, deadline_s: float | None, max_bytes: int = MAX_FRAME_BYTES) -> ProtocolFrame:
        """Implement `FrameChannel.receive`."""
        data = self._data or self._read(deadline_s)
        while len(data) < HEADER_BYTES:
            data = self._data = data + self._read(deadline_s, len(data))
        header = read_header(data, max_bytes)
        end = HEADER_BYTES + header.size
        if len(data) < end:
            data = self._read_until(data, end, deadline_s)
        self._data = data[end:]
        return ProtocolFrame(header, data[HEADER_BYTES:end])

    def _read_until(self, first_bytes: bytes, min_bytes: int, deadline_s: float | None) -> bytes:
        """Return `first_bytes` and the bytes that are received after them, at least `min_bytes` in total."""
        data = bytearray(first_bytes)
        try:
            while len(data) < min_bytes:
                data += self._read(deadline_s, len(data))
        finally:
            self._data = bytes(data)
        return self._data

    def close(self) -> None:
        """Implement `FrameChannel.close`."""
        for fd in self._fds:
            os.close(fd)
        self._fds = set()

    def _require_open(self) -> None:
        """Raise ClosedError if this channel is closed: its descriptors may now belong to another file."""
        if not self._fds:
            raise ClosedError("the connection was closed")

    def _read(self, deadline_s: float | None, bytes_before: int = 0) -> bytes:
        """Return the next bytes, at least one.

        Args:
            deadline_s: Time of `time.monotonic` until which to wait; None for no deadline.
            bytes_before: Number of bytes of the same frame that were already read, for the error message.
        """
        self._require_open()
        while True:
            _wait(self._readable, deadline_s)
            try:
                chunk = os.read(self._read_fd, _CHUNK_BYTES)
            except BlockingIOError:
                continue
            except OSError as error:
                raise ClosedError("the connection was closed") from error
            if not chunk:
                position_text = f" after {bytes_before} bytes of a frame" if bytes_before else ""
                raise ClosedError(f"the connection was closed{position_text}")
            return chunk


def _wait(poll: select.poll, deadline_s: float | None) -> None:
    if deadline_s is None:
        poll.poll()
        return
    remaining_s = deadline_s - time.monotonic()
    if remaining_s <= 0 or not poll.poll(remaining_s * 1e3):
        raise DeadlineError("the wait reached its deadline")


def socket_channel(connection: socket.socket) -> StreamChannel:
    """Return a channel over a connected TCP socket; the channel closes the socket.

    Small frames are sent immediately (RFC 9293, section 3.7.4, on Nagle's algorithm), and an idle connection whose
    other side has disappeared is closed after a minute (keepalive, RFC 9293, section 3.8.4). If sent data are
    unacknowledged, Linux retransmits them for about 15 minutes before it closes the connection (`tcp_retries2`).
    """
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, 20), (socket.TCP_KEEPINTVL, 10), (socket.TCP_KEEPCNT, 4)):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
    fd = connection.detach()
    return StreamChannel(fd, fd)
