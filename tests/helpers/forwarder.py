"""Forwards streams from loopback ports to other endpoints over links that can fail like radio links."""

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
_MAX_CHUNKS: Final = 1000
"""Maximum number of chunks in a delayed direction of a stream."""

# From asm-generic/socket.h; a classic BPF program with the single instruction `ret #0` drops all packets.
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_DROP_ALL: Final = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
_DROP_ALL_PROGRAM: Final = struct.pack("HxxxxxxP", 1, ctypes.addressof(_DROP_ALL))


@dataclass(eq=False)
class _Flow:
    """One direction of a stream.

    Attributes:
        source: Socket that is read.
        sink: Socket that is written.
        queue: Received chunks with the time from which each may be sent; an empty chunk is the end of the stream.
        source_closed: True if the source has sent its end of stream.
        sink_closed: True if the end of stream was forwarded.
    """

    source: socket.socket
    sink: socket.socket
    queue: deque[tuple[float, bytes]] = field(default_factory=deque)
    source_closed: bool = False
    sink_closed: bool = False

    def due_in_s(self) -> float | None:
        """Seconds until the next chunk may be sent, 0 if it may be sent now; None if there is no chunk."""
        return max(self.queue[0][0] - time.monotonic(), 0.0) if self.queue else None

    def can_read(self, delay_s: float) -> bool:
        """Return True if it accepts more data; without a delay, only after the last chunk was sent."""
        return not self.source_closed and (not self.queue or (delay_s > 0 and len(self.queue) < _MAX_CHUNKS))

    def receive(self, delay_s: float) -> None:
        """Read the next chunk from the source."""
        chunk = self.source.recv(_CHUNK)
        self.source_closed = not chunk
        self.queue.append((time.monotonic() + delay_s, chunk))

    def send(self) -> None:
        """Send as much of the next chunk as possible without blocking, or the end of the stream."""
        due_in_s, chunk = self.queue.popleft()
        if not chunk:
            self.sink_closed = True
            self.sink.shutdown(socket.SHUT_WR)
        elif unsent := chunk[self.sink.send(chunk) :]:
            self.queue.appendleft((due_in_s, unsent))


@dataclass(eq=False)
class _Link:
    """A loopback port, and the streams that are forwarded from it."""

    connect: Connect
    listener: socket.socket
    is_cut: bool = False
    delay_s: float = 0.0
    streams: list[tuple[_Flow, _Flow]] = field(default_factory=list)

    def client_sockets(self) -> list[socket.socket]:
        return [self.listener, *(forward.source for forward, _ in self.streams)]

    def accept(self) -> None:
        client, _ = self.listener.accept()
        try:
            server = self.connect(_CONNECT_S)
        except OSError:
            _reset(client)
            return
        for end in (client, server):
            end.setblocking(False)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.streams.append((_Flow(client, server), _Flow(server, client)))

    def forward_ready(self, readable: set[socket.socket], writable: set[socket.socket]) -> None:
        for stream in list(self.streams):
            try:
                for flow in stream:
                    if flow.source in readable and flow.can_read(self.delay_s):
                        flow.receive(self.delay_s)
                    if flow.due_in_s() == 0 and (flow.sink in writable or not flow.queue[0][1]):
                        flow.send()
            except OSError:
                self.close_stream(stream, _reset)
            else:
                if all(flow.sink_closed for flow in stream):
                    self.close_stream(stream, socket.socket.close)
        if self.listener in readable:
            self.accept()

    def close_stream(self, stream: tuple[_Flow, _Flow], close: Callable[[socket.socket], None]) -> None:
        self.streams.remove(stream)
        for flow in stream:
            close(flow.source)


class Forwarder(Generic[Key]):
    """Listens on a free loopback port per key and forwards each stream to the endpoint of the key.

    It has one thread and is a context manager.

    Args:
        endpoints: For each key, a function that connects to the endpoint within a number of seconds, or raises
            OSError.
    """

    def __init__(self, endpoints: Mapping[Key, Connect]) -> None:
        self._links = {
            key: _Link(connect, socket.create_server(("127.0.0.1", 0))) for key, connect in endpoints.items()
        }
        self._lock = threading.Lock()
        self._wake, self._wake_receiver = socket.socketpair()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="forwarder")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._wake.send(b"x")
        self._thread.join()
        for key, link in self._links.items():
            self.drop(key)
            link.listener.close()
        self._wake.close()
        self._wake_receiver.close()

    def port(self, key: Key) -> int:
        """The port of `key`."""
        port: int = self._links[key].listener.getsockname()[1]
        return port

    def reach(self, key: Key, timeout_s: float = _CONNECT_S) -> socket.socket:
        """Open a stream through the port of `key`; raise OSError if it cannot be opened in time."""
        return socket.create_connection(("127.0.0.1", self.port(key)), timeout_s)

    def cut(self, key: Key) -> None:
        """Cut the link: no data, FIN, RST or ACK is sent any more, and new connections hang."""
        link = self._links[key]
        with self._lock:
            link.is_cut = True
            for end in link.client_sockets():
                end.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, _DROP_ALL_PROGRAM)

    def restore(self, key: Key) -> None:
        """Restore the link if it is cut; streams that are still open at both ends continue."""
        link = self._links[key]
        with self._lock:
            if not link.is_cut:
                return
            link.is_cut = False
            for end in link.client_sockets():
                end.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
        self._wake.send(b"x")

    def delay(self, key: Key, delay_s: float) -> None:
        """Delay all data that is received from now on, in both directions."""
        with self._lock:
            self._links[key].delay_s = delay_s
        self._wake.send(b"x")

    def drop(self, key: Key) -> None:
        """Reset all streams; new streams are forwarded."""
        link = self._links[key]
        with self._lock:
            for stream in list(link.streams):
                link.close_stream(stream, _reset)
        # The kernel resets a socket only when no `select` waits for it any more.
        self._wake.send(b"x")

    def _run(self) -> None:
        while not self._stopping:
            readers, writers, wait_s = self._select_arguments()
            try:
                readable, writable, _ = select.select(readers, writers, [], wait_s)
            except (OSError, ValueError):
                continue  # `drop` has closed one of the sockets
            if self._wake_receiver in readable:
                self._wake_receiver.recv(_CHUNK)
            with self._lock:
                for link in self._links.values():
                    if not link.is_cut:
                        link.forward_ready({*readable}, {*writable})

    def _select_arguments(self) -> tuple[list[socket.socket], list[socket.socket], float | None]:
        """The arguments of `select`: sockets to read, sockets to write, and the timeout."""
        with self._lock:
            intact_links = [link for link in self._links.values() if not link.is_cut]
            flows = [(link.delay_s, flow) for link in intact_links for stream in link.streams for flow in stream]
            readers = [flow.source for delay_s, flow in flows if flow.can_read(delay_s)]
            flows_due = [(flow.due_in_s(), flow) for _, flow in flows]
            writers = [flow.sink for due_in_s, flow in flows_due if due_in_s == 0]
            waits_s = [due_in_s for due_in_s, _ in flows_due if due_in_s]
            listeners = [link.listener for link in intact_links]
            return [self._wake_receiver, *listeners, *readers], writers, min(waits_s, default=None)


def _reset(end: socket.socket) -> None:
    end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    end.close()
