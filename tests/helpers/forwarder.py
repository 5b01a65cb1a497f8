"""Streams carried from loopback ports to somewhere else, by links that can die as a radio link does."""

import ctypes
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Final, Generic, Self, TypeVar

Key = TypeVar("Key", bound=Hashable)
Connect = Callable[[float], socket.socket]

_CHUNK: Final = 1 << 16
_CONNECT_S: Final = 5.0
_MOST_PIECES: Final = 1000
"""That a delayed direction of a stream holds."""

# asm-generic/socket.h; a classic BPF program of one instruction, `ret #0`, drops every packet.
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_DROP_ALL: Final = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
_DROP_ALL_PROGRAM: Final = struct.pack("HxxxxxxP", 1, ctypes.addressof(_DROP_ALL))


@dataclass(eq=False)
class _Flow:
    """One direction of a stream.

    Attributes:
        source: Where bytes come from.
        sink: Where they go.
        queue: Pieces that have come, each with the time from which it may go on; an empty one is the end.
        finished: Whether the end has come from the source.
        ended: Whether it was passed on.
    """

    source: socket.socket
    sink: socket.socket
    queue: deque[tuple[float, bytes]] = field(default_factory=deque)
    finished: bool = False
    ended: bool = False

    def due_s(self) -> float | None:
        """Return in how many seconds a piece may go on, 0 for now; None where there is none."""
        return max(self.queue[0][0] - time.monotonic(), 0.0) if self.queue else None

    def reads(self, delay_s: float) -> bool:
        """Whether it takes more: without a delay, not before the last piece has gone on."""
        return not self.finished and (not self.queue or (delay_s > 0 and len(self.queue) < _MOST_PIECES))

    def take(self, delay_s: float) -> None:
        """Take what has come."""
        piece = self.source.recv(_CHUNK)
        self.finished = not piece
        self.queue.append((time.monotonic() + delay_s, piece))

    def give(self) -> None:
        """Pass on what may go on and can without waiting; the end, too."""
        due_s, piece = self.queue.popleft()
        if not piece:
            self.ended = True
            self.sink.shutdown(socket.SHUT_WR)
        elif left := piece[self.sink.send(piece) :]:
            self.queue.appendleft((due_s, left))


@dataclass(eq=False)
class _Link:
    """A port and the streams through it."""

    connect: Connect
    listener: socket.socket
    dead: bool = False
    delay_s: float = 0.0
    streams: list[tuple[_Flow, _Flow]] = field(default_factory=list)

    def near_ends(self) -> list[socket.socket]:
        return [self.listener, *(there.source for there, _ in self.streams)]

    def accept(self) -> None:
        near, _ = self.listener.accept()
        try:
            far = self.connect(_CONNECT_S)
        except OSError:
            _reset(near)
            return
        for end in (near, far):
            end.setblocking(False)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.streams.append((_Flow(near, far), _Flow(far, near)))

    def carry(self, readable: set[socket.socket], writable: set[socket.socket]) -> None:
        for stream in list(self.streams):
            try:
                for flow in stream:
                    if flow.source in readable and flow.reads(self.delay_s):
                        flow.take(self.delay_s)
                    if flow.due_s() == 0 and (flow.sink in writable or not flow.queue[0][1]):
                        flow.give()
            except OSError:
                self.end(stream, _reset)
            else:
                if all(flow.ended for flow in stream):
                    self.end(stream, socket.socket.close)
        if self.listener in readable:
            self.accept()

    def end(self, stream: tuple[_Flow, _Flow], close: Callable[[socket.socket], None]) -> None:
        self.streams.remove(stream)
        for flow in stream:
            close(flow.source)


class Forwarder(Generic[Key]):
    """Listens on a free loopback port per key and carries each stream to where `connect` of the key leads.

    One thread; use as a context manager.

    Args:
        ways: Opens a stream to the far side, within so many seconds, or raises OSError.
    """

    def __init__(self, ways: Mapping[Key, Connect]) -> None:
        self._links = {key: _Link(way, socket.create_server(("127.0.0.1", 0))) for key, way in ways.items()}
        self._lock = threading.Lock()
        self._wake, self._woken = socket.socketpair()
        self._over = False
        self._thread = threading.Thread(target=self._run, name="forwarder")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over = True
        self._wake.send(b"x")
        self._thread.join()
        for key, link in self._links.items():
            self.drop(key)
            link.listener.close()
        self._wake.close()
        self._woken.close()

    def port(self, key: Key) -> int:
        """Return the port of `key`."""
        port: int = self._links[key].listener.getsockname()[1]
        return port

    def reach(self, key: Key, timeout_s: float = _CONNECT_S) -> socket.socket:
        """Return a stream through the port of `key`; raises OSError when there is none in time."""
        return socket.create_connection(("127.0.0.1", self.port(key)), timeout_s)

    def cut(self, key: Key) -> None:
        """Let the link die: no byte, FIN, RST or ACK comes from it any more, and new connections hang."""
        link = self._links[key]
        with self._lock:
            link.dead = True
            for end in link.near_ends():
                end.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, _DROP_ALL_PROGRAM)

    def restore(self, key: Key) -> None:
        """Let the link come back, if it is dead; streams that both sides still hold go on where they stood."""
        link = self._links[key]
        with self._lock:
            if not link.dead:
                return
            link.dead = False
            for end in link.near_ends():
                end.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
        self._wake.send(b"x")

    def delay(self, key: Key, delay_s: float) -> None:
        """Deliver what comes from now on this much later, either way."""
        with self._lock:
            self._links[key].delay_s = delay_s
        self._wake.send(b"x")

    def drop(self, key: Key) -> None:
        """Reset every stream; new ones are carried."""
        link = self._links[key]
        with self._lock:
            for stream in list(link.streams):
                link.end(stream, _reset)
        # A stream is reset when nobody waits on it any more.
        self._wake.send(b"x")

    def _run(self) -> None:
        while not self._over:
            reading, writing, wait_s = self._watched()
            try:
                readable, writable, _ = select.select(reading, writing, [], wait_s)
            except (OSError, ValueError):
                continue  # `drop` closed one of them
            if self._woken in readable:
                self._woken.recv(_CHUNK)
            with self._lock:
                for link in self._links.values():
                    if not link.dead:
                        link.carry({*readable}, {*writable})

    def _watched(self) -> tuple[list[socket.socket], list[socket.socket], float | None]:
        """Return what to read from, what to write to, and after which time to look again in any case."""
        with self._lock:
            alive = [link for link in self._links.values() if not link.dead]
            flows = [(link.delay_s, flow) for link in alive for stream in link.streams for flow in stream]
            reading = [flow.source for delay_s, flow in flows if flow.reads(delay_s)]
            due = [(flow.due_s(), flow) for _, flow in flows]
            writing = [flow.sink for due_s, flow in due if due_s == 0]
            waits_s = [due_s for due_s, _ in due if due_s]
            listeners = [link.listener for link in alive]
            return [self._woken, *listeners, *reading], writing, min(waits_s, default=None)


def _reset(end: socket.socket) -> None:
    end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    end.close()
