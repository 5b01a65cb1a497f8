"""The link server: it owns the connection to an autopilot and forwards frames between it and its clients.

Clients are connected by a Unix-domain socket of packets. The first byte of a packet says what it is: `FRAMES` whole
frames, `ALIVE` a question of a client whether the server works, `STATE` its answer, as JSON.
"""

from __future__ import annotations

import errno
import json
import os
import selectors
import signal
import socket
import struct
import sys
import threading
import time
import traceback
from contextlib import suppress
from typing import Any, Mapping

from fieldkit.agent.links import devices, places
from fieldkit.agent.links.devices import FlightDevice
from fieldkit.agent.links.intervals import MessageIntervals, Target
from fieldkit.agent.mavlink_frames import (
    COMMAND_ACK,
    COMMAND_LONG,
    SET_MESSAGE_INTERVAL,
    FrameHead,
    FrameWriter,
    frames,
    head,
    is_intact,
)

FRAMES, ALIVE, STATE = b"F", b"P", b"S"

_OWN = 245, 194
"""System and component of the server: MAV_COMP_ID_ONBOARD_COMPUTER4, so that no client has the same."""
_COMMAND = struct.Struct("<7fHBB")
_ANSWER = struct.Struct("<HB5xBB")
_TURN_S = 0.02
_LINGERS_S = 1.0
"""It ends that long after its last client at the latest."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 0.5
"""Bounds of the time between two attempts to open the connection."""
_SILENT_S = 5.0
"""After that long without a byte a connection of TCP is opened anew: its other end may be gone without a word."""
_MOST_CLIENTS = 16
_BUFFER_BYTES = 1 << 20


class SharedDevice:
    """The connection to the autopilot, opened again after each error.

    A thread opens it: the name of a host, a connection or a line may take long, and clients must be answered.

    Args:
        connection: Its name.

    Attributes:
        error: Number and text of the last error.
        lost_since_s: Monotonic time since which it is not open; None while it is.
    """

    def __init__(self, connection: str) -> None:
        self._connection = connection
        self._device: FlightDevice | None = None
        self._opening: threading.Thread | None = None
        self._opened: list[FlightDevice | OSError] = []
        self._next_s, self._pause_s = 0.0, _FIRST_PAUSE_S
        self._buffer = bytearray()
        self._heard_s = 0.0
        self.error = (0, "")
        self.lost_since_s: float | None = time.monotonic()

    def fileno(self) -> int:
        """Return the descriptor to wait for; -1 while it is not open."""
        return -1 if self._device is None else self._device.fileno()

    def advance(self, now_s: float) -> bool:
        """Go on with opening; return whether it was opened just now."""
        if self._device is not None:
            if self._connection.startswith("tcp:") and now_s > self._heard_s + _SILENT_S:
                self._lose(TimeoutError(errno.ETIMEDOUT, f"no byte in {_SILENT_S:g} s"))
            return False
        if self._opening is None and now_s >= self._next_s:
            self._opening = threading.Thread(target=self._open, daemon=True)
            self._opening.start()
        if not self._opened:
            return False
        opened, self._opening = self._opened.pop(), None
        if isinstance(opened, OSError):
            self.error = opened.errno or errno.EIO, opened.strerror or str(opened)
            self._next_s, self._pause_s = now_s + self._pause_s, min(2 * self._pause_s, _LONGEST_PAUSE_S)
            return False
        self._device, self.lost_since_s, self._pause_s = opened, None, _FIRST_PAUSE_S
        self._heard_s = now_s
        self._buffer.clear()
        return True

    def _open(self) -> None:
        try:
            self._opened.append(devices.opened(self._connection))
        except OSError as error:
            self._opened.append(error)

    def receive(self) -> list[bytes]:
        """Return the frames that have arrived."""
        if self._device is None:
            return []
        try:
            data = self._device.read()
        except OSError as error:
            self._lose(error)
            return []
        if data:
            self._heard_s = time.monotonic()
        if self._device.whole:
            return list(frames(bytearray(data)))
        self._buffer += data
        return list(frames(self._buffer))

    def send(self, frame: bytes) -> None:
        """Send a frame; while the connection is not open it is left out."""
        if self._device is not None:
            try:
                self._device.write(frame)
            except OSError as error:
                self._lose(error)

    def flush(self) -> None:
        """Send what waits for a slow line."""
        if self._device is not None:
            try:
                self._device.flush()
            except OSError as error:
                self._lose(error)

    def _lose(self, error: OSError) -> None:
        self.error = error.errno or errno.EIO, error.strerror or str(error)
        self.close()
        self.lost_since_s = time.monotonic()
        self._next_s = 0.0

    def close(self) -> None:
        """Close it."""
        if self._device is not None:
            self._device.close()
            self._device = None


class LinkClient:
    """A client of the server.

    Args:
        stream: To the client.

    Attributes:
        left_out: Frames that it was too slow to take.
    """

    def __init__(self, stream: socket.socket) -> None:
        self.stream = stream
        self.left_out = 0
        stream.setblocking(False)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)

    def send(self, packet: bytes, count: int = 0) -> None:
        """Send a packet of frames; what a slow client cannot take is left out and counted."""
        try:
            self.stream.send(packet)
        except OSError:
            self.left_out += count


class LinkServer:
    """Forwards frames between an autopilot and the programs of fieldkit on its computer.

    Args:
        connection: To the autopilot.
        listener: Where clients connect.
    """

    def __init__(self, connection: str, listener: socket.socket) -> None:
        self._device = SharedDevice(connection)
        self._listener = listener
        self._clients: dict[int, LinkClient] = {}
        self._writer = FrameWriter(*_OWN)
        self._intervals = MessageIntervals(self._request)
        self._waiting = selectors.DefaultSelector()
        self._waiting.register(listener, selectors.EVENT_READ)
        self._watched = -1
        self._left_s = time.monotonic()

    def run(self, over: threading.Event) -> None:
        """Serve until the last client left and the intervals are as before, or for `_LINGERS_S` after it.

        A signal does not take the connection from clients: they may have a drone in the air.
        """
        while True:
            now_s = time.monotonic()
            if self._clients:
                self._left_s = now_s
            elif now_s > self._left_s + _LINGERS_S or (over.is_set() and self._intervals.settled):
                break
            if self._device.advance(now_s):
                self._intervals.reopened()
            self._watch()
            for key, _ in self._waiting.select(_TURN_S):
                self._serve(key.fd)
            self._device.flush()
            self._intervals.advance(time.monotonic())
        self._device.close()

    def _watch(self) -> None:
        """Wait for the device that is open now."""
        if self._watched == self._device.fileno():
            return
        if self._watched >= 0:
            self._waiting.unregister(self._watched)
        self._watched = self._device.fileno()
        if self._watched >= 0:
            self._waiting.register(self._watched, selectors.EVENT_READ)

    def _serve(self, descriptor: int) -> None:
        if descriptor == self._listener.fileno():
            self._accept()
        elif descriptor == self._watched:
            self._distribute(self._device.receive())
            self._watch()  # before another descriptor gets the same number
        elif descriptor in self._clients:
            self._take(descriptor, self._clients[descriptor])

    def _accept(self) -> None:
        with suppress(OSError):  # it has gone already
            stream, _ = self._listener.accept()
            if places.peer(stream)[1] != os.geteuid() or len(self._clients) >= _MOST_CLIENTS:
                stream.close()
                return
            self._clients[stream.fileno()] = LinkClient(stream)
            self._waiting.register(stream, selectors.EVENT_READ)

    def _distribute(self, came: list[bytes]) -> None:
        now_s = time.monotonic()
        for frame in came:
            message = head(frame)
            source = message.system, message.component
            self._intervals.heard(source, message.kind, now_s)
            if message.kind == COMMAND_ACK and is_intact(frame):
                self._answered(source, message, now_s)
        if came:
            packet = FRAMES + b"".join(came)
            for client in self._clients.values():
                client.send(packet, len(came))

    def _answered(self, source: Target, message: FrameHead, now_s: float) -> None:
        command, result, *to = _ANSWER.unpack(message.payload[: _ANSWER.size].ljust(_ANSWER.size, b"\0"))
        if command == SET_MESSAGE_INTERVAL and tuple(to) in (_OWN, (0, 0)):
            self._intervals.answered(source, result, now_s)

    def _take(self, descriptor: int, client: LinkClient) -> None:
        """Take a packet of a client."""
        try:
            packet = client.stream.recv(devices.MOST_BYTES)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self._waiting.unregister(client.stream)
            client.stream.close()
            del self._clients[descriptor]
            self._intervals.leave(descriptor)
        elif packet[:1] == ALIVE:
            client.send(STATE + json.dumps(self._state(descriptor)).encode())
        elif packet[:1] == FRAMES:
            for frame in frames(bytearray(packet[1:])):
                if not self._arbitrate(descriptor, frame):
                    self._device.send(frame)

    def _arbitrate(self, client: int, frame: bytes) -> bool:
        """Take a request for an interval, which is not forwarded; return whether the frame is one."""
        message = head(frame)
        if message.kind != COMMAND_LONG or not is_intact(frame):
            return False
        payload = message.payload[: _COMMAND.size].ljust(_COMMAND.size, b"\0")
        *parameters, command, system, component = _COMMAND.unpack(payload)
        if command != SET_MESSAGE_INTERVAL:
            return False
        with suppress(ValueError, OverflowError):  # not a number
            self._intervals.request(client, (system, component), int(parameters[0]), int(parameters[1]))
        return True

    def _request(self, target: Target, kind: int, interval_us: int) -> None:
        self._device.send(self._writer.command(target, SET_MESSAGE_INTERVAL, kind, interval_us))

    def _state(self, client: int) -> Mapping[str, Any]:
        return {
            "lost_since_s": self._device.lost_since_s,
            "error": self._device.error,
            "left_out": self._clients[client].left_out,
            "messages": self._intervals.report(client, time.monotonic()),
        }


def serve(connection: str, over: threading.Event) -> None:
    """Serve a connection in a process of its own; return when it serves, or when another server does.

    Raises:
        OSError: The folder of sockets cannot be used.
        ValueError: It is not the name of a connection.
    """
    devices.check(connection)
    lock = places.lock(connection)
    if lock is None:
        return
    ready, tell = os.pipe()
    if os.fork():
        os.close(tell)
        os.read(ready, 1)  # or the end of the file, if it failed
        return
    code = 1
    try:
        os.close(ready)
        _detach(f"{places.folder()}/{places.name(connection)}.log")
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener, places.address(connection) as address:
            with suppress(FileNotFoundError):
                os.unlink(address)  # noqa: PTH108 (of a server that was killed)
            listener.bind(address)
            os.chmod(address, 0o600)  # noqa: PTH101
            listener.listen(_MOST_CLIENTS)
            listener.setblocking(False)
            os.close(tell)
            LinkServer(connection, listener).run(over)
            places.remove(connection)  # before the lock is gone
        code = 0
    except Exception:  # noqa: BLE001 (the log has it, and clients start another server)
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _detach(log: str) -> None:
    """Leave the session, the folder and the files of the client that started this process; write errors to a log."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    os.chdir("/")
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1):
        os.dup2(null, descriptor)
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600), 2)
