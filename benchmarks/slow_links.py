"""Control links with a long round-trip time, as on bad Wi-Fi. They count sequential round trips.

One thread forwards streams over loopback and delays every byte by half a round trip. Round trips are counted with a
logical clock: data from this computer has a number one above the highest number received over any link, and data from
a robot has the highest number that the robot has received. Therefore parallel round trips count once.
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
_MAX_IN_FLIGHT: Final = 1 << 12  # chunks of a direction
_CONNECT_S: Final = 10.0


@dataclass(eq=False)
class _Direction:
    """One direction of a stream.

    Attributes:
        source: Socket from which bytes are read.
        sink: Socket to which they are written.
        in_flight: Delayed chunks: due time, trip number, and the bytes, which are empty at the end of the stream.
        ended: True if the source has reached its end.
    """

    source: socket.socket
    sink: socket.socket
    in_flight: deque[tuple[float, int, bytes]] = field(default_factory=deque)
    ended: bool = False


@dataclass(eq=False)
class _Stream:
    """Both directions of a stream. `trip` is the highest trip number that the robot has received."""

    to_robot: _Direction
    from_robot: _Direction
    trip: int = 0


class SlowLinks:
    """Forwards streams with a delay; use as a context manager.

    Args:
        round_trip_s: Round-trip time in seconds.

    Attributes:
        trips: Number of sequential round trips.
    """

    def __init__(self, round_trip_s: float) -> None:
        self.trips = 0
        self._delay_s = round_trip_s / 2
        self._streams: list[_Stream] = []
        self._listeners: dict[socket.socket, Connect] = {}
        self._lock = threading.Lock()
        self._wake_sender, self._wake_receiver = socket.socketpair()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="slow links")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._wake_sender.send(b"x")
        self._thread.join()
        for stream in list(self._streams):
            self._end(stream)
        for opened in (*self._listeners, self._wake_sender, self._wake_receiver):
            opened.close()

    def carry(self, far_end: socket.socket) -> socket.socket:
        """Return the near end of a new stream to `far_end`."""
        with socket.create_server(("127.0.0.1", 0)) as listener:
            near_end = socket.create_connection(listener.getsockname(), _CONNECT_S)
            self._add(listener.accept()[0], far_end)
        return near_end

    def port(self, connect: Connect) -> int:
        """Return a loopback port. `connect` opens the far end of each stream to this port."""
        listener = socket.create_server(("127.0.0.1", 0))
        with self._lock:
            self._listeners[listener] = connect
        self._wake_sender.send(b"x")
        port: int = listener.getsockname()[1]
        return port

    def _add(self, near_end: socket.socket, far_end: socket.socket) -> None:
        for end in (near_end, far_end):
            end.settimeout(_CONNECT_S)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._streams.append(_Stream(_Direction(near_end, far_end), _Direction(far_end, near_end)))
        self._wake_sender.send(b"x")

    def _run(self) -> None:
        """Forward data until the links are closed."""
        while not self._closed:
            with self._lock:
                sources = {
                    direction.source: (stream, direction)
                    for stream, direction in self._directions()
                    if self._is_readable(direction)
                }
                due_s = [direction.in_flight[0][0] for _, direction in self._directions() if direction.in_flight]
                listeners = dict(self._listeners)
            wait_s = max(0.0, min(due_s) - time.monotonic()) if due_s else None
            readable, _, _ = select.select([self._wake_receiver, *listeners, *sources], [], [], wait_s)
            for ready in readable:
                if ready is self._wake_receiver:
                    ready.recv(_CHUNK)
                elif ready in listeners:
                    self._add(ready.accept()[0], listeners[ready](_CONNECT_S))
                else:
                    self._read(*sources[ready])
            for stream, direction in self._directions():
                self._deliver(stream, direction)

    def _directions(self) -> Iterator[tuple[_Stream, _Direction]]:
        for stream in list(self._streams):
            yield stream, stream.to_robot
            yield stream, stream.from_robot

    def _is_readable(self, direction: _Direction) -> bool:
        return not direction.ended and len(direction.in_flight) < _MAX_IN_FLIGHT

    def _read(self, stream: _Stream, direction: _Direction) -> None:
        trip = self.trips + 1 if direction is stream.to_robot else stream.trip
        try:
            chunk = direction.source.recv(_CHUNK)
        except OSError:
            chunk = b""
        direction.ended = not chunk
        direction.in_flight.append((time.monotonic() + self._delay_s, trip, chunk))

    def _deliver(self, stream: _Stream, direction: _Direction) -> None:
        """Write the chunks that are due, and count their round trips."""
        while direction.in_flight and direction.in_flight[0][0] <= time.monotonic():
            _, trip, chunk = direction.in_flight.popleft()
            if not chunk:
                self._end(stream)
                return
            if direction is stream.to_robot:
                stream.trip = max(stream.trip, trip)
            else:
                self.trips = max(self.trips, trip)
            try:
                direction.sink.sendall(chunk)
            except OSError:
                self._end(stream)
                return

    def _end(self, stream: _Stream) -> None:
        with self._lock, contextlib.suppress(ValueError):
            self._streams.remove(stream)
        stream.to_robot.source.close()
        stream.to_robot.sink.close()


@contextlib.contextmanager
def slow_control(round_trip_s: float) -> Iterator[SlowLinks]:
    """Route every control connection to emulated robots over slow links, in labs that are opened in the body."""
    direct = EmulatedRobot.connect
    with (
        SlowLinks(round_trip_s) as slow,
        mock.patch.object(EmulatedRobot, "connect", lambda robot, timeout_s: slow.carry(direct(robot, timeout_s))),
    ):
        yield slow
