"""A MAVLink forwarder with the behaviour of mavlink-router, between an autopilot on UDP and its clients.

The UDP server answers only the client from which it received last. The TCP server has several clients. A COMMAND_ACK
is forwarded only to endpoints that have sent frames with the system and component of its target.
"""

import selectors
import socket
import threading
import time
from contextlib import suppress
from typing import Final, Self

from fieldkit.agent.autopilots.mavlink_frames import COMMAND_ACK, frames, parse_frame

_POLL_S: Final = 0.05
_CLOSE_LIMIT_S: Final = 60.0
Address = tuple[int, int]


class MavlinkRouter:
    """Forwards frames while its context is active.

    Args:
        autopilot: UDP port of the autopilot on loopback.
        max_clients: Maximum number of TCP connections; 1 is like the port of an autopilot.

    Attributes:
        udp: Port of the UDP server.
        tcp: Port of the TCP server.
        accepted: Number of accepted TCP connections.
        withheld: Number of times that a COMMAND_ACK was not forwarded to an endpoint.
    """

    def __init__(self, autopilot: int, max_clients: int = 100) -> None:
        self._autopilot = ("127.0.0.1", autopilot)
        self._max_clients = max_clients
        self.accepted = self.withheld = 0
        self._stopping = threading.Event()
        self._is_down = threading.Event()
        self._down_until_s = 0.0
        self._autopilot_socket = socket.socket(type=socket.SOCK_DGRAM)
        self._server = socket.socket(type=socket.SOCK_DGRAM)
        self._server.bind(("127.0.0.1", 0))
        self.udp = self._server.getsockname()[1]
        self._listener: socket.socket | None = socket.create_server(("127.0.0.1", 0))
        self.tcp = self._listener.getsockname()[1]
        self._last_udp_client: tuple[str, int] | None = None
        self._streams: dict[socket.socket, bytearray] = {}
        self._addresses: dict[object, set[Address]] = {}
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()
        for end in (self._autopilot_socket, self._server, self._listener, *self._streams):
            if end is not None:
                end.close()

    def restart(self, duration_s: float) -> None:
        """Close all TCP connections, and refuse new ones for a time.

        Returns when the connections are closed.
        """
        self._is_down.clear()
        self._down_until_s = time.monotonic() + duration_s
        assert self._is_down.wait(_CLOSE_LIMIT_S), "the router did not close its connections"

    @property
    def clients(self) -> int:
        """Number of open TCP connections."""
        return len(self._streams)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._update_outage()
            with selectors.DefaultSelector() as selector:
                listeners = [self._listener] if self._listener and len(self._streams) < self._max_clients else []
                for end in (self._autopilot_socket, self._server, *listeners, *self._streams):
                    selector.register(end, selectors.EVENT_READ)
                for key, _ in selector.select(_POLL_S):
                    self._serve(key.fileobj)  # type: ignore[arg-type]

    def _update_outage(self) -> None:
        if time.monotonic() < self._down_until_s:
            if self._listener is not None:
                self._listener.close()
                self._listener = None
            for stream in self._streams:
                stream.close()
            self._streams.clear()
            self._last_udp_client = None
            self._addresses.clear()
            self._is_down.set()
        elif self._listener is None:
            self._listener = socket.create_server(("127.0.0.1", self.tcp))

    def _serve(self, end: socket.socket) -> None:
        if end is self._listener:
            stream, _ = end.accept()
            self._streams[stream] = bytearray()
            self.accepted += 1
        elif end is self._autopilot_socket:
            with suppress(ConnectionRefusedError):
                for frame in frames(bytearray(self._autopilot_socket.recv(65_536))):
                    self._to_clients(frame)
        elif end is self._server:
            data, sender = self._server.recvfrom(65_536)
            if self._listener is not None:
                self._last_udp_client = sender
                self._to_autopilot("udp", bytearray(data))
        else:
            try:
                data = end.recv(65_536)
            except OSError:
                data = b""
            if not data:
                del self._streams[end]
                end.close()
                return
            self._streams[end] += data
            self._to_autopilot(end, self._streams[end])

    def _to_autopilot(self, endpoint: object, buffer: bytearray) -> None:
        for frame in frames(buffer):
            sender = parse_frame(frame)
            self._addresses.setdefault(endpoint, set()).add((sender.system, sender.component))
            self._autopilot_socket.sendto(frame, self._autopilot)

    def _to_clients(self, frame: bytes) -> None:
        message = parse_frame(frame)
        target = tuple(message.payload.ljust(10, b"\0")[8:10]) if message.kind == COMMAND_ACK else (0, 0)
        for endpoint in ("udp", *self._streams):
            if target != (0, 0) and target not in self._addresses.get(endpoint, set()):
                self.withheld += 1
            elif isinstance(endpoint, socket.socket):
                with suppress(OSError):
                    endpoint.sendall(frame)
            elif self._last_udp_client is not None:
                self._server.sendto(frame, self._last_udp_client)
