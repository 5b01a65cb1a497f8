"""Ways to an autopilot: UDP either way round, TCP, a serial line.

Named as MAVLink's tools name them: `udpout:HOST:PORT` speaks first, `udpin:HOST:PORT` waits for who speaks first,
`tcp:HOST:PORT`, `/dev/ttyAMA0:921600`.
"""

from __future__ import annotations

import os
import socket
import termios
import time
import tty
from contextlib import suppress
from typing import Iterator, Protocol

from fieldkit.agent.mavlink_frames import frames

MOST_BYTES = 65_536
_CONNECTS_S = 5.0
_GONE_S = 3.0
"""Who was not heard for so long gives its place to who speaks next: it has begun anew, at another port."""


class FlightLink(Protocol):
    """A way to an autopilot."""

    def fileno(self) -> int:
        """Return the descriptor to wait for."""

    def receive(self) -> Iterator[bytes]:
        """Yield the frames that have come; bytes that are in none are left out.

        Raises:
            OSError: The other end is gone.
        """

    def send(self, frame: bytes) -> None:
        """Send a frame, if that is possible now."""

    def close(self) -> None:
        """End it."""


def opened(connection: str) -> FlightLink:
    """Return a way to an autopilot.

    Raises:
        OSError: It cannot be opened.
        ValueError: It is named otherwise.
    """
    kind, _, rest = connection.partition(":")
    if kind.startswith("/"):
        return StreamFlightLink(_serial(kind, int(rest)))
    host, _, port = rest.rpartition(":")
    if kind == "tcp":
        stream = socket.create_connection((host, int(port)), timeout=_CONNECTS_S)
        stream.settimeout(None)
        return StreamFlightLink(stream.detach())
    if kind in ("udpout", "udpin"):
        return UdpFlightLink((host, int(port)), listens=kind == "udpin")
    raise ValueError(f"{connection} is none of udpout:, udpin:, tcp: and /dev/")


class UdpFlightLink:
    """Datagrams: each has whole frames, and one that was cut does not spoil the next.

    Args:
        address: Whom to speak to; or where to listen.
        listens: Whether to wait for who speaks first.
    """

    def __init__(self, address: tuple[str, int], *, listens: bool) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._peer = None if listens else address
        self._listens = listens
        self._heard_s = float("-inf")
        if listens:
            self._socket.bind(address)
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """See `FlightLink.fileno`."""
        return self._socket.fileno()

    def receive(self) -> Iterator[bytes]:
        """See `FlightLink.receive`."""
        datagram = b""
        with suppress(BlockingIOError, ConnectionRefusedError):  # nobody listens there, yet
            datagram, sender = self._socket.recvfrom(MOST_BYTES)
            now_s = time.monotonic()
            if self._listens and (sender == self._peer or now_s > self._heard_s + _GONE_S):
                self._peer, self._heard_s = sender, now_s
        yield from frames(bytearray(datagram))

    def send(self, frame: bytes) -> None:
        """See `FlightLink.send`; on the air a datagram may be lost anyway."""
        if self._peer is not None:
            with suppress(OSError):
                self._socket.sendto(frame, self._peer)

    def close(self) -> None:
        """See `FlightLink.close`."""
        self._socket.close()


class StreamFlightLink:
    """Bytes in their order.

    Args:
        descriptor: What they are read from and written to.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._buffer = bytearray()
        os.set_blocking(descriptor, False)

    def fileno(self) -> int:
        """See `FlightLink.fileno`."""
        return self._descriptor

    def receive(self) -> Iterator[bytes]:
        """See `FlightLink.receive`."""
        with suppress(BlockingIOError):
            data = os.read(self._descriptor, MOST_BYTES)
            if not data:
                raise ConnectionResetError("the other end has closed the connection")
            self._buffer += data
        yield from frames(self._buffer)

    def send(self, frame: bytes) -> None:
        """See `FlightLink.send`."""
        with suppress(OSError):
            os.write(self._descriptor, frame)

    def close(self) -> None:
        """See `FlightLink.close`."""
        os.close(self._descriptor)


def _serial(path: str, baud: int) -> int:
    """Open a serial line: 8 bits, no parity, no handshake, at this rate."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise ValueError(f"{path} has no rate of {baud} baud")
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(descriptor, termios.TCSANOW)
        settings = termios.tcgetattr(descriptor)
        settings[2] |= termios.CLOCAL | termios.CREAD
        settings[2] &= ~termios.CRTSCTS
        settings[4] = settings[5] = speed
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    except termios.error as error:
        raise OSError(*error.args) from error
    return descriptor
