"""Control links of a chosen round-trip time, as bad Wi-Fi has, which count the round trips that happen in sequence.

Streams are carried over loopback by one thread that holds every byte back for half a round trip. Trips are counted as
logical clocks count: what this computer sends is one trip later than all that it has received, over any of the
links, and what a robot sends is as late as all that it has received. Whatever goes side by side counts once.
"""

import contextlib
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, Self
from unittest import mock

from sim_backends.emulated.nodes import EmulatedRobot

Connect = Callable[[float], socket.socket]

_CHUNK: Final = 1 << 16
_IN_FLIGHT: Final = 1 << 12
_CONNECT_S: Final = 10.0


@dataclass(eq=False)
class _Way:
    """One direction of a stream.

    Attributes:
        source: Where bytes come from.
        sink: Where they go.
        flight: What is under way: when it is due, its trip, and the bytes, none for the end.
    """

    source: socket.socket
    sink: socket.socket
    flight: deque[tuple[float, int, bytes]] = field(default_factory=deque)
    ended: bool = False


@dataclass(eq=False)
class _Stream:
    """Both directions of a stream: `there` to the robot, `back` to this computer; `trip` is the robot's."""

    there: _Way
    back: _Way
    trip: int = 0


class SlowLinks:
    """Carries streams slowly; use as a context manager.

    Args:
        round_trip_s: How long from a byte to the answer of a robot that answers at once.
    """

    def __init__(self, round_trip_s: float) -> None:
        self.trips = 0
        self._delay_s = round_trip_s / 2
        self._streams: list[_Stream] = []
        self._listeners: dict[socket.socket, Connect] = {}
        self._lock = threading.Lock()
        self._wake, self._woken = socket.socketpair()
        self._over = False
        self._thread = threading.Thread(target=self._run, name="slow links")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over = True
        self._wake.send(b"x")
        self._thread.join()
        for stream in list(self._streams):
            self._end(stream)
        for one in (*self._listeners, self._wake, self._woken):
            one.close()

    def carry(self, far: socket.socket) -> socket.socket:
        """Return the near end of a new stream that leads to `far`."""
        with socket.create_server(("127.0.0.1", 0)) as listener:
            near = socket.create_connection(listener.getsockname(), _CONNECT_S)
            self._add(listener.accept()[0], far)
        return near

    def port(self, connect: Connect) -> int:
        """Return a loopback port whose streams lead to where `connect` does."""
        listener = socket.create_server(("127.0.0.1", 0))
        with self._lock:
            self._listeners[listener] = connect
        self._wake.send(b"x")
        port: int = listener.getsockname()[1]
        return port

    def _add(self, near: socket.socket, far: socket.socket) -> None:
        for end in (near, far):
            end.settimeout(_CONNECT_S)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._streams.append(_Stream(_Way(near, far), _Way(far, near)))
        self._wake.send(b"x")

    def _run(self) -> None:
        while not self._over:
            with self._lock:
                sources = {way.source: (stream, way) for stream, way in self._ways() if self._takes(way)}
                due_s = [way.flight[0][0] for _, way in self._ways() if way.flight]
                listeners = dict(self._listeners)
            wait_s = max(0.0, min(due_s) - time.monotonic()) if due_s else None
            readable, _, _ = select.select([self._woken, *listeners, *sources], [], [], wait_s)
            for one in readable:
                if one is self._woken:
                    one.recv(_CHUNK)
                elif one in listeners:
                    self._add(one.accept()[0], listeners[one](_CONNECT_S))
                else:
                    self._take(*sources[one])
            for stream, way in self._ways():
                self._deliver(stream, way)

    def _ways(self) -> Iterator[tuple[_Stream, _Way]]:
        for stream in list(self._streams):
            yield stream, stream.there
            yield stream, stream.back

    def _takes(self, way: _Way) -> bool:
        return not way.ended and len(way.flight) < _IN_FLIGHT

    def _take(self, stream: _Stream, way: _Way) -> None:
        trip = self.trips + 1 if way is stream.there else stream.trip
        try:
            chunk = way.source.recv(_CHUNK)
        except OSError:
            chunk = b""
        way.ended = not chunk
        way.flight.append((time.monotonic() + self._delay_s, trip, chunk))

    def _deliver(self, stream: _Stream, way: _Way) -> None:
        while way.flight and way.flight[0][0] <= time.monotonic():
            _, trip, chunk = way.flight.popleft()
            if not chunk:
                self._end(stream)
                return
            if way is stream.there:
                stream.trip = max(stream.trip, trip)
            else:
                self.trips = max(self.trips, trip)
            try:
                way.sink.sendall(chunk)
            except OSError:
                self._end(stream)
                return

    def _end(self, stream: _Stream) -> None:
        with self._lock, contextlib.suppress(ValueError):
            self._streams.remove(stream)
        stream.there.source.close()
        stream.there.sink.close()


@contextlib.contextmanager
def slow_control(round_trip_s: float) -> Iterator[SlowLinks]:
    """Let every control connection to an emulated robot go over slow links, of labs that are opened meanwhile."""
    direct = EmulatedRobot.connect
    with (
        SlowLinks(round_trip_s) as slow,
        mock.patch.object(EmulatedRobot, "connect", lambda robot, timeout_s: slow.carry(direct(robot, timeout_s))),
    ):
        yield slow
