"""Connections to an autopilot: UDP in both directions, TCP, serial lines.

The names follow MAVLink's tools: `udpout:HOST:PORT` sends first, `udpin:HOST:PORT` waits for the first datagram,
`tcp:HOST:PORT`, `/dev/ttyAMA0:921600`.
"""

from __future__ import annotations

import os
import socket
import termios
import time
import tty
from contextlib import suppress
from typing import Protocol

MAX_BYTES = 65_536
_CONNECT_TIMEOUT_S = 2.0
_PEER_TIMEOUT_S = 3.0
"""If the peer sends no datagram for this time, the next sender becomes the peer: a restarted peer has a new port."""
_MAX_QUEUED_BYTES = 4096
"""Maximum number of queued bytes for a slow line: 0.7 s at 57600 baud. Older data would be useless."""


class FlightDevice(Protocol):
    """An open connection to an autopilot."""

    has_whole_frames: bool
    """Whether each read returns complete frames."""

    def fileno(self) -> int:
        """Return the file descriptor to wait for."""

    def read(self) -> bytes:
        """Return the bytes that have arrived; empty if there are none.

        Raises:
            OSError: The connection is lost.
        """

    def write(self, frame: bytes) -> None:
        """Send a complete frame, or drop it if the line is busy.

        Raises:
            OSError: The connection is lost.
        """

    def flush(self) -> None:
        """Send queued bytes of a slow line. Raises the same errors as `write`."""

    def close(self) -> None:
        """Close the connection."""


def check(connection: str) -> None:
    """Check the name of a connection.

    Raises:
        ValueError: The name is invalid.
    """
    kind, _, suffix = connection.partition(":")
    if kind.startswith("/"):
        if not suffix.isdigit() or not hasattr(termios, f"B{int(suffix)}"):
            raise ValueError(f"{connection} has no valid baud rate; write for example {kind}:57600")
        return
    host, _, port = suffix.rpartition(":")
    if kind not in ("tcp", "udpout", "udpin"):
        raise ValueError(f"{connection} is not a connection: it must start with udpout:, udpin:, tcp: or /dev/")
    if not host or not port.isdigit() or not 0 < int(port) < 65_536:
        raise ValueError(f"{connection} has no HOST:PORT")


def open_device(connection: str) -> FlightDevice:
    """Open a connection to an autopilot.

    Raises:
        OSError: It cannot be opened.
        ValueError: The name of the connection is invalid.
    """
    check(connection)
    kind, _, suffix = connection.partition(":")
    if kind.startswith("/"):
        return StreamDevice(_open_serial(kind, int(suffix)))
    host, _, port = suffix.rpartition(":")
    if kind == "tcp":
        stream = socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT_S)
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        stream.settimeout(None)
        return StreamDevice(stream.detach())
    return UdpDevice((host, int(port)), listens=kind == "udpin")


class UdpDevice:
    """UDP. Each datagram contains complete frames, so a truncated frame does not affect the next datagram.

    Args:
        address: The destination, or the local address if `listens`.
        listens: Whether to wait for the first datagram, whose sender becomes the peer.
    """

    has_whole_frames = True

    def __init__(self, address: tuple[str, int], *, listens: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._peer = None if listens else (socket.gethostbyname(address[0]), address[1])
        self._listens = listens
        self._received_s = float("-inf")
        try:
            if listens:
                self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the file descriptor to wait for."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """Return the next datagram; an unreachable port is not an error, because the peer may start later."""
        with suppress(BlockingIOError, ConnectionRefusedError):
            datagram, sender = self._socket.recvfrom(MAX_BYTES)
            now_s = time.monotonic()
            if self._listens and (sender == self._peer or now_s > self._received_s + _PEER_TIMEOUT_S):
                self._peer, self._received_s = sender, now_s
            return datagram
        return b""

    def write(self, frame: bytes) -> None:
        """Send a frame; errors are ignored, because datagrams may be lost anyway."""
        if self._peer is not None:
            with suppress(OSError):
                self._socket.sendto(frame, self._peer)

    def flush(self) -> None:
        """Do nothing: datagrams are not queued."""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class StreamDevice:
    """A byte stream: TCP or a serial line.

    Args:
        descriptor: The file descriptor of the stream; it is closed with the device.
    """

    has_whole_frames = False

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._queue = bytearray()
        os.set_blocking(descriptor, False)

    def fileno(self) -> int:
        """Return the file descriptor to wait for."""
        return self._descriptor

    def read(self) -> bytes:
        """Return the bytes that have arrived; raises `ConnectionResetError` at the end of the stream."""
        try:
            data = os.read(self._descriptor, MAX_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError("the other end has closed the connection")
        return data

    def write(self, frame: bytes) -> None:
        """Send a frame, or drop it if too many bytes are queued."""
        if len(self._queue) + len(frame) <= _MAX_QUEUED_BYTES:
            self._queue += frame
        self.flush()

    def flush(self) -> None:
        """Send queued bytes."""
        with suppress(BlockingIOError):
            while self._queue:
                del self._queue[: os.write(self._descriptor, self._queue)]

    def close(self) -> None:
        """Close the file descriptor."""
        os.close(self._descriptor)


def _open_serial(path: str, baud: int) -> int:
    """Open a serial line with 8 data bits, no parity and no flow control at this rate."""
    speed = getattr(termios, f"B{baud}")
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(descriptor, termios.TCSANOW)
        settings = termios.tcgetattr(descriptor)
        # Entry 2 has the control flags; entries 4 and 5 are the input and the output speed.
        settings[2] |= termios.CLOCAL | termios.CREAD
        settings[2] &= ~termios.CRTSCTS
        settings[4] = settings[5] = speed
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    except termios.error as error:
        os.close(descriptor)
        raise OSError(*error.args) from error
    return descriptor
