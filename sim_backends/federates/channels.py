"""Channels between both sides: byte streams that carry frames, with a deadline on every wait."""

import os
import select
import socket
import time
from typing import Final, Protocol

from sim_backends.federates.frames import HEADER_BYTES, MAX_FRAME_BYTES, ProtocolFrame, read_header

_CHUNK_BYTES: Final = 1 << 16


class ClosedError(ConnectionError):
    """The other side closed the channel."""


class DeadlineError(TimeoutError):
    """A wait reached its deadline."""


class FrameChannel(Protocol):
    """Carries frames."""

    def send(self, frame: bytes, deadline_s: float | None) -> None:
        """Send a frame.

        Args:
            frame: The frame.
            deadline_s: Time of `time.monotonic` until which to wait; None for no deadline.

        Raises:
            ClosedError: The other side closed the channel.
            DeadlineError: It did not read in time.
        """
        ...

    def receive(self, deadline_s: float | None, max_bytes: int = MAX_FRAME_BYTES) -> ProtocolFrame:
        """Return the next frame.

        Args:
            deadline_s: As for `send`.
            max_bytes: Largest allowed size of a body.

        Raises:
            ClosedError: The other side closed the channel.
            DeadlineError: No whole frame has arrived in time.
            MalformedFrameError: The header is malformed.
        """
        ...

    def close(self) -> None:
        """Close the channel; nothing happens if it is closed."""
        ...


class StreamChannel:
    """A channel over file descriptors: two pipes, or a socket.

    Memory for a frame is allocated while its bytes arrive, so that an announced size alone costs nothing.

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
        self._data = bytearray()

    def send(self, frame: bytes, deadline_s: float | None) -> None:
        """Implement `FrameChannel.send`."""
        rest = memoryview(frame)
        while rest:
            try:
                rest = rest[os.write(self._write_fd, rest) :]
            except BlockingIOError:
                _wait(self._writable, deadline_s)
            except OSError as error:
                raise ClosedError("the connection was closed") from error

    def receive(self, deadline_s: float | None, max_bytes: int = MAX_FRAME_BYTES) -> ProtocolFrame:
        """Implement `FrameChannel.receive`."""
        data = self._data
        while len(data) < HEADER_BYTES:
            self._read(deadline_s)
        header = read_header(data, max_bytes)
        end = HEADER_BYTES + header.size
        while len(data) < end:
            self._read(deadline_s)
        body = bytes(memoryview(data)[HEADER_BYTES:end])
        del data[:end]
        return ProtocolFrame(header, body)

    def close(self) -> None:
        """Implement `FrameChannel.close`."""
        for fd in self._fds:
            os.close(fd)
        self._fds = set()

    def _read(self, deadline_s: float | None) -> None:
        if not self._fds:
            raise ClosedError("the connection was closed")
        _wait(self._readable, deadline_s)
        try:
            received = os.read(self._read_fd, _CHUNK_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            raise ClosedError("the connection was closed") from error
        if not received:
            rest = f" after {len(self._data)} bytes of a frame" if self._data else ""
            raise ClosedError(f"the connection was closed{rest}")
        self._data += received


def _wait(poll: select.poll, deadline_s: float | None) -> None:
    if deadline_s is None:
        poll.poll()
        return
    left_s = deadline_s - time.monotonic()
    if left_s <= 0 or not poll.poll(left_s * 1e3):
        raise DeadlineError("the wait reached its deadline")


def socket_channel(connection: socket.socket) -> StreamChannel:
    """Return a channel over a connected TCP socket, which it owns.

    Small frames are sent immediately (RFC 9293, section 3.7.4, on Nagle's algorithm), and a connection whose other
    side has disappeared is closed after a minute.
    """
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_KEEPIDLE, 20), (socket.TCP_KEEPINTVL, 10), (socket.TCP_KEEPCNT, 4)):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
    fd = connection.detach()
    return StreamChannel(fd, fd)
