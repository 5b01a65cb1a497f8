"""Connections to an autopilot: UDP in both directions, TCP, a serial line.

They are named as MAVLink's tools name them: `udpout:HOST:PORT` sends first, `udpin:HOST:PORT` waits for the first
datagram, `tcp:HOST:PORT`, `/dev/ttyAMA0:921600`.
"""

from __future__ import annotations

import os
import socket
import termios
import time
import tty
from contextlib import suppress
from typing import Protocol

MOST_BYTES = 65_536
_CONNECTS_S = 2.0
_GONE_S = 3.0
"""After that long without a datagram from a peer, the next sender replaces it: it restarted at another port."""
_MOST_WAITING_BYTES = 4096
"""Bytes that wait for a slow line: 0.7 s at 57600 baud. More would be too late to be useful."""


class FlightDevice(Protocol):
    """An open connection to an autopilot."""

    whole: bool
    """Whether each read returns whole frames."""

    def fileno(self) -> int:
        """Return the descriptor to wait for."""

    def read(self) -> bytes:
        """Return the bytes that have arrived; empty if there are none.

        Raises:
            OSError: The connection has ended.
        """

    def write(self, frame: bytes) -> None:
        """Send a frame, or leave it out whole if the line is busy.

        Raises:
            OSError: The connection has ended.
        """

    def flush(self) -> None:
        """Send what waits for a slow line; errors as `write`."""

    def close(self) -> None:
        """Close it."""


def check(connection: str) -> None:
    """Check the name of a connection.

    Raises:
        ValueError: It is not the name of a connection.
    """
    kind, _, rest = connection.partition(":")
    if kind.startswith("/"):
        if not rest.isdigit() or not hasattr(termios, f"B{int(rest)}"):
            raise ValueError(f"{kind} has no rate of {rest} baud")
        return
    host, _, port = rest.rpartition(":")
    if kind not in ("tcp", "udpout", "udpin"):
        raise ValueError(f"{connection} is not a connection: udpout:, udpin:, tcp: or /dev/")
    if not host or not port.isdigit() or not 0 < int(port) < 65_536:
        raise ValueError(f"{connection} has no HOST:PORT")


def opened(connection: str) -> FlightDevice:
    """Return an open connection to an autopilot.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is not the name of a connection.
    """
    check(connection)
    kind, _, rest = connection.partition(":")
    if kind.startswith("/"):
        return StreamDevice(_serial(kind, int(rest)))
    host, _, port = rest.rpartition(":")
    if kind == "tcp":
        stream = socket.create_connection((host, int(port)), timeout=_CONNECTS_S)
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        stream.settimeout(None)
        return StreamDevice(stream.detach())
    return UdpDevice((host, int(port)), listens=kind == "udpin")


class UdpDevice:
    """Datagrams: each has whole frames, and a truncated one does not damage the next.

    Args:
        address: The destination; or the address to listen at.
        listens: Whether to wait for the first datagram.
    """

    whole = True

    def __init__(self, address: tuple[str, int], *, listens: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._peer = None if listens else (socket.gethostbyname(address[0]), address[1])
        self._listens = listens
        self._heard_s = float("-inf")
        try:
            if listens:
                self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """See `FlightDevice.fileno`."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """See `FlightDevice.read`; an unreachable port is not an error: the other end may start later."""
        with suppress(BlockingIOError, ConnectionRefusedError):
            datagram, sender = self._socket.recvfrom(MOST_BYTES)
            now_s = time.monotonic()
            if self._listens and (sender == self._peer or now_s > self._heard_s + _GONE_S):
                self._peer, self._heard_s = sender, now_s
            return datagram
        return b""

    def write(self, frame: bytes) -> None:
        """See `FlightDevice.write`; a datagram may be lost anyway, so an error of one is not reported."""
        if self._peer is not None:
            with suppress(OSError):
                self._socket.sendto(frame, self._peer)

    def flush(self) -> None:
        """See `FlightDevice.flush`; nothing waits."""

    def close(self) -> None:
        """See `FlightDevice.close`."""
        self._socket.close()


class StreamDevice:
    """A byte stream: TCP or a serial line.

    Args:
        descriptor: What is read from and written to; it is closed with the device.
    """

    whole = False

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._waiting = bytearray()
        os.set_blocking(descriptor, False)

    def fileno(self) -> int:
        """See `FlightDevice.fileno`."""
        return self._descriptor

    def read(self) -> bytes:
        """See `FlightDevice.read`."""
        try:
            data = os.read(self._descriptor, MOST_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionResetError("the other end has closed the connection")
        return data

    def write(self, frame: bytes) -> None:
        """See `FlightDevice.write`."""
        if len(self._waiting) + len(frame) <= _MOST_WAITING_BYTES:
            self._waiting += frame
        self.flush()

    def flush(self) -> None:
        """See `FlightDevice.flush`."""
        with suppress(BlockingIOError):
            while self._waiting:
                del self._waiting[: os.write(self._descriptor, self._waiting)]

    def close(self) -> None:
        """See `FlightDevice.close`."""
        os.close(self._descriptor)


def _serial(path: str, baud: int) -> int:
    """Open a serial line: 8 bits, no parity, no handshake, at this rate."""
    speed = getattr(termios, f"B{baud}")
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(descriptor, termios.TCSANOW)
        settings = termios.tcgetattr(descriptor)
        settings[2] |= termios.CLOCAL | termios.CREAD
        settings[2] &= ~termios.CRTSCTS
        settings[4] = settings[5] = speed
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    except termios.error as error:
        os.close(descriptor)
        raise OSError(*error.args) from error
    return descriptor
