"""The stream from a sensor's topic to one of its subscribers; never waits for it."""

import contextlib
import selectors
import socket
from typing import Final

from sim_backends.emulated.ros import tcpros

QUEUE_BYTES: Final = 4 << 20
"""What a slow subscriber may leave unread; beyond it messages are dropped for it, as from a ROS publisher's queue."""

_CHUNK: Final = 1 << 16


class Subscriber:
    """One subscriber, from its connection to its end.

    Args:
        stream: Its socket.
        header: What it is told of the topic before all messages: a packet.
        selector: Waits for the socket; it is told to call `serve` with the events.

    Attributes:
        hears: Whether it has asked for the topic.
        gone: Whether it has left, which one that breaks off or speaks another protocol has.
    """

    def __init__(self, stream: socket.socket, header: bytes, selector: selectors.BaseSelector) -> None:
        self.hears = False
        self.gone = False
        self._stream = stream
        self._header = header
        self._selector = selector
        self._packets = tcpros.Packets()
        self._unsent = bytearray()
        stream.setblocking(False)
        selector.register(stream, selectors.EVENT_READ, self.serve)

    def send(self, packet: bytes) -> None:
        """Send a packet as soon as there is room for it; drop it where too much waits already."""
        if not self.gone and len(self._unsent) < QUEUE_BYTES:
            self._unsent += packet
            self._flush()

    def serve(self, events: int) -> None:
        """Do what the socket is ready for."""
        if events & selectors.EVENT_WRITE:
            self._flush()
        if events & selectors.EVENT_READ and not self.gone:
            self._read()

    def _flush(self) -> None:
        try:
            with contextlib.suppress(BlockingIOError):
                del self._unsent[: self._stream.send(self._unsent)]
        except OSError:
            self._leave()
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._unsent else 0)
        if self._selector.get_key(self._stream).events != wanted:
            self._selector.modify(self._stream, wanted, self.serve)

    def _read(self) -> None:
        try:
            data = self._stream.recv(_CHUNK)
            if not self.hears:
                self._packets.feed(data)
                self._answer()
        except BlockingIOError:
            return
        except (OSError, ValueError):
            data = b""
        if not data and not self.gone:
            self._leave()

    def _answer(self) -> None:
        """Answer its connection header once that is whole; whatever comes after it says nothing."""
        for packet in self._packets:
            tcpros.unpack_header(packet)
            self.hears = True
            self.send(self._header)
            return

    def _leave(self) -> None:
        self.gone = True
        self._selector.unregister(self._stream)
        self._stream.close()
