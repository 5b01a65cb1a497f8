"""Multiplexing: each connection of a lab to a virtual machine is a stream of bytes on the machine's only channel.

A frame has the number of its stream, its kind and its length, then data. The host opens streams; a stream ends when
both sides have sent END. A frame with an invalid header ends the channel, because the other side is not trusted.
"""

import contextlib
import os
import queue
import socket
import struct
import threading
from collections.abc import Callable
from typing import Final

from fieldkit.core.errors import TestbedLostError

_HEADER: Final = struct.Struct(">IBH")
_OPEN, _DATA, _END = range(3)
_CHUNK_BYTES: Final = 1 << 15
_MAX_STREAMS: Final = 256
_MAX_PENDING: Final = 2048
"""Maximum number of frames that wait for a slow reader; if there are more, its stream is closed."""


class _ChannelStream:
    """One stream of the channel.

    Attributes:
        near: End of a socket pair that the user of the stream reads and writes.
        far: Other end of the pair, which the threads of the channel read and write.
        frames: Data of received frames; b"" at the end of the stream.
        open_directions: Number of directions that have not ended.
    """

    def __init__(self) -> None:
        self.near, self.far = socket.socketpair()
        self.frames: queue.Queue[bytes] = queue.Queue(_MAX_PENDING)
        self.open_directions = 2


class ChannelStreams:
    """The streams of one side. Its threads end when the channel ends, or with the process.

    Args:
        descriptor: Descriptor of the channel.
        accept: Called in a new thread with the socket of each stream that the other side opens; None to accept none.

    Attributes:
        has_ended: True if the channel has ended.
    """

    def __init__(self, descriptor: int, accept: Callable[[socket.socket], None] | None = None) -> None:
        self._descriptor = descriptor
        self._accept = accept
        self._streams: dict[int, _ChannelStream] = {}
        self._next_number = 0
        self._lock = threading.Lock()
        self._write_lock = threading.Lock()
        self.has_ended = False

    def open(self) -> socket.socket:
        """Open a stream and return its socket.

        Raises:
            TestbedLostError: The channel has ended, or has too many streams.
        """
        with self._lock:
            if self.has_ended or len(self._streams) >= _MAX_STREAMS:
                cause = "has ended" if self.has_ended else f"has {_MAX_STREAMS} open streams"
                raise TestbedLostError(f"the channel to the virtual machine {cause}", remedy="fieldkit lab down")
            number = self._next_number
            self._next_number += 1
            stream = self._streams[number] = _ChannelStream()
        self._send(number, _OPEN)
        self._start(number, stream)
        return stream.near

    def run(self) -> None:
        """Read the channel until it ends, then end all streams."""
        try:
            while (header := self._read(_HEADER.size)) is not None:
                number, kind, size = _HEADER.unpack(header)
                data = self._read(size)
                if data is None or kind > _END or size > _CHUNK_BYTES:
                    break
                self._receive(number, kind, data)
        finally:
            with self._lock:
                self.has_ended = True
                remaining = list(self._streams.values())
            for stream in remaining:
                _shut(stream.far, socket.SHUT_RDWR)
                with contextlib.suppress(queue.Full):
                    stream.frames.put_nowait(b"")

    def _receive(self, number: int, kind: int, data: bytes) -> None:
        """Handle a frame of the other side: it opens a stream, has data for one, or ends one.

        Frames of unknown streams, and streams beyond the limit, are ignored.
        """
        with self._lock:
            stream = self._streams.get(number)
            if kind == _OPEN and stream is None and self._accept is not None and len(self._streams) < _MAX_STREAMS:
                stream = self._streams[number] = _ChannelStream()
            elif kind == _OPEN:
                return
        if stream is None:
            return
        if kind == _OPEN:
            assert self._accept is not None
            self._start(number, stream)
            threading.Thread(target=self._accept, args=(stream.near,), daemon=True).start()
            return
        try:
            stream.frames.put_nowait(data if kind == _DATA else b"")
        except queue.Full:
            _shut(stream.far, socket.SHUT_RDWR)

    def _start(self, number: int, stream: _ChannelStream) -> None:
        for work in (self._send_data, self._deliver):
            threading.Thread(target=work, args=(number, stream), daemon=True).start()

    def _send_data(self, number: int, stream: _ChannelStream) -> None:
        """Send the data that is written to the near end."""
        data = b""
        with contextlib.suppress(OSError):
            while data := stream.far.recv(_CHUNK_BYTES):
                self._send(number, _DATA, data)
        self._send(number, _END)
        self._end_direction(number, stream)

    def _deliver(self, number: int, stream: _ChannelStream) -> None:
        """Write received data to the near end."""
        while data := stream.frames.get():
            try:
                stream.far.sendall(data)
            except OSError:
                break
        _shut(stream.far, socket.SHUT_WR)
        self._end_direction(number, stream)

    def _end_direction(self, number: int, stream: _ChannelStream) -> None:
        with self._lock:
            stream.open_directions -= 1
            if stream.open_directions:
                return
            self._streams.pop(number, None)
        stream.far.close()

    def _send(self, number: int, kind: int, data: bytes = b"") -> None:
        frame = _HEADER.pack(number, kind, len(data)) + data
        with self._write_lock, contextlib.suppress(OSError):
            while frame:
                frame = frame[os.write(self._descriptor, frame) :]

    def _read(self, size: int) -> bytes | None:
        """Return this number of bytes, or None if the channel ended before."""
        data = b""
        while len(data) < size:
            try:
                part = os.read(self._descriptor, size - len(data))
            except OSError:
                part = b""
            if not part:
                return None
            data += part
        return data


def _shut(end: socket.socket, how: int) -> None:
    with contextlib.suppress(OSError):
        end.shutdown(how)
