"""A forwarder of MAVLink with the behaviour of mavlink-router, between an autopilot at UDP and its clients.

Its UDP server answers the client that it heard last; its TCP server serves many; it forwards a COMMAND_ACK only to
the endpoint on which its addressee was heard.
"""

import selectors
import socket
import threading
import time
from contextlib import suppress
from typing import Final, Self

from fieldkit.agent.mavlink_frames import COMMAND_ACK, frames, head

_TURN_S: Final = 0.05
Address = tuple[int, int]


class MavlinkRouter:
    """Forwards while it is used as a context.

    Args:
        autopilot: Port of UDP on loopback at which the autopilot is.
        most_clients: Connections of TCP that it serves; 1 is what an autopilot's own port does.

    Attributes:
        udp: Port of its UDP server.
        tcp: Port of its TCP server.
        accepted: Connections of TCP that it has accepted.
        withheld: COMMAND_ACKs that it did not forward to an endpoint.
    """

    def __init__(self, autopilot: int, most_clients: int = 100) -> None:
        self._autopilot = ("127.0.0.1", autopilot)
        self._most = most_clients
        self.accepted = self.withheld = 0
        self._over = threading.Event()
        self._down_until_s = 0.0
        self._master = socket.socket(type=socket.SOCK_DGRAM)
        self._server = socket.socket(type=socket.SOCK_DGRAM)
        self._server.bind(("127.0.0.1", 0))
        self.udp = self._server.getsockname()[1]
        self._listener: socket.socket | None = socket.create_server(("127.0.0.1", 0))
        self.tcp = self._listener.getsockname()[1]
        self._last: tuple[str, int] | None = None
        self._streams: dict[socket.socket, bytearray] = {}
        self._heard: dict[object, set[Address]] = {}
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        for end in (self._master, self._server, self._listener, *self._streams):
            if end is not None:
                end.close()

    def restart(self, lasts_s: float) -> None:
        """Close all connections of TCP, refuse new ones for that long, then accept them again."""
        self._down_until_s = time.monotonic() + lasts_s

    @property
    def clients(self) -> int:
        """How many connections of TCP it serves."""
        return len(self._streams)

    def _run(self) -> None:
        while not self._over.is_set():
            self._be_down()
            with selectors.DefaultSelector() as waiting:
                listening = [self._listener] if self._listener and len(self._streams) < self._most else []
                for end in (self._master, self._server, *listening, *self._streams):
                    waiting.register(end, selectors.EVENT_READ)
                for key, _ in waiting.select(_TURN_S):
                    self._serve(key.fileobj)  # type: ignore[arg-type]

    def _be_down(self) -> None:
        if time.monotonic() < self._down_until_s:
            if self._listener is not None:
                self._listener.close()
                self._listener = None
            for stream in self._streams:
                stream.close()
            self._streams.clear()
            self._last = None
            self._heard.clear()
        elif self._listener is None:
            self._listener = socket.create_server(("127.0.0.1", self.tcp))

    def _serve(self, end: socket.socket) -> None:
        if end is self._listener:
            stream, _ = end.accept()
            self._streams[stream] = bytearray()
            self.accepted += 1
        elif end is self._master:
            with suppress(ConnectionRefusedError):
                for frame in frames(bytearray(self._master.recv(65_536))):
                    self._to_clients(frame)
        elif end is self._server:
            data, sender = self._server.recvfrom(65_536)
            if self._listener is not None:
                self._last = sender
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
            sender = head(frame)
            self._heard.setdefault(endpoint, set()).add((sender.system, sender.component))
            self._master.sendto(frame, self._autopilot)

    def _to_clients(self, frame: bytes) -> None:
        message = head(frame)
        to = tuple(message.payload.ljust(10, b"\0")[8:10]) if message.kind == COMMAND_ACK else (0, 0)
        for endpoint in ("udp", *self._streams):
            if to != (0, 0) and to not in self._heard.get(endpoint, set()):
                self.withheld += 1
            elif isinstance(endpoint, socket.socket):
                with suppress(OSError):
                    endpoint.sendall(frame)
            elif self._last is not None:
                self._server.sendto(frame, self._last)
