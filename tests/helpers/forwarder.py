"""Streams carried from loopback ports to somewhere else, by links that can die as a radio link does."""

import ctypes
import select
import socket
import struct
import threading
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Final, Generic, Self, TypeVar

Key = TypeVar("Key", bound=Hashable)
Connect = Callable[[float], socket.socket]

_CHUNK: Final = 1 << 16
_CONNECT_S: Final = 5.0

# asm-generic/socket.h; a classic BPF program of one instruction, `ret #0`, drops every packet.
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_DROP_ALL: Final = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
_DROP_ALL_PROGRAM: Final = struct.pack("HxxxxxxP", 1, ctypes.addressof(_DROP_ALL))


@dataclass(eq=False)
class _Flow:
    """One direction of a stream."""

    source: socket.socket
    sink: socket.socket
    pending: bytes = b""
    ended: bool = False

    def carry(self) -> None:
        """Move what can be moved without waiting; pass the end on."""
        if self.pending:
            self.pending = self.pending[self.sink.send(self.pending) :]
        else:
            self.pending = self.source.recv(_CHUNK)
            if not self.pending:
                self.ended = True
                self.sink.shutdown(socket.SHUT_WR)


@dataclass(eq=False)
class _Link:
    """A port and the streams through it."""

    connect: Connect
    listener: socket.socket
    dead: bool = False
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
                    if (flow.sink in writable) if flow.pending else (flow.source in readable):
                        flow.carry()
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
            reading, writing = self._watched()
            try:
                readable, writable, _ = select.select(reading, writing, [])
            except (OSError, ValueError):
                continue  # `drop` closed one of them
            if self._woken in readable:
                self._woken.recv(_CHUNK)
            with self._lock:
                for link in self._links.values():
                    if not link.dead:
                        link.carry({*readable}, {*writable})

    def _watched(self) -> tuple[list[socket.socket], list[socket.socket]]:
        with self._lock:
            alive = [link for link in self._links.values() if not link.dead]
            flows = [flow for link in alive for stream in link.streams for flow in stream]
            reading = [flow.source for flow in flows if not flow.pending and not flow.ended]
            writing = [flow.sink for flow in flows if flow.pending]
            return [self._woken, *(link.listener for link in alive), *reading], writing


def _reset(end: socket.socket) -> None:
    end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    end.close()
