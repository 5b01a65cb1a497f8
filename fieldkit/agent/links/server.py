"""The link server. It owns the connection to an autopilot, and forwards frames between the autopilot and clients.

Clients connect to a Unix-domain socket of type SOCK_SEQPACKET. The first byte of a packet is its type: `FRAMES`
precedes complete frames, `ALIVE` is a poll of a client, and `STATE` precedes the answer to it, a JSON object.
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

from fieldkit.agent.autopilots.mavlink_frames import (
    COMMAND_ACK,
    COMMAND_LONG,
    SET_MESSAGE_INTERVAL,
    FrameWriter,
    ParsedFrame,
    frames,
    is_intact,
    parse_frame,
)
from fieldkit.agent.links import devices, link_files
from fieldkit.agent.links.devices import FlightDevice
from fieldkit.agent.links.intervals import MessageIntervals, Target

FRAMES, ALIVE, STATE = b"F", b"P", b"S"

_SERVER_ADDRESS = 245, 194
"""System and component id of the server: MAV_COMP_ID_ONBOARD_COMPUTER4, which no client uses."""
_COMMAND = struct.Struct("<7fHBB")
_COMMAND_ACK = struct.Struct("<HB5xBB")
_POLL_S = 0.02
_LINGER_S = 1.0
"""Maximum time for which the server runs without clients, at its start or after the last one has disconnected."""
_FIRST_PAUSE_S, _MAX_PAUSE_S = 0.1, 0.5
"""Bounds of the time between two attempts to open the connection."""
_SILENT_S = 5.0
"""After this time without a byte a TCP connection is reopened: its peer may have disappeared without a FIN."""
_MAX_CLIENTS = 16
_BUFFER_BYTES = 1 << 20


class SharedDevice:
    """The connection to the autopilot, which is reopened after each error.

    It is opened in a separate thread, because name resolution, TCP or a serial line may take long, and clients must
    be answered in the meantime.

    Args:
        connection: Name of the connection.

    Attributes:
        error: Number and text of the last error; 0 and an empty text if there was none.
        lost_since_s: Monotonic time since which the connection is closed; None while it is open.
    """

    def __init__(self, connection: str) -> None:
        self._connection = connection
        self._device: FlightDevice | None = None
        self._open_thread: threading.Thread | None = None
        self._open_results: list[FlightDevice | OSError] = []
        self._next_open_s, self._pause_s = 0.0, _FIRST_PAUSE_S
        self._buffer = bytearray()
        self._received_s = 0.0
        self.error = (0, "")
        self.lost_since_s: float | None = time.monotonic()

    def fileno(self) -> int:
        """Return the file descriptor to wait for; -1 while the connection is closed."""
        return -1 if self._device is None else self._device.fileno()

    def advance(self, now_s: float) -> bool:
        """Reopen the connection if it is lost, without blocking; return True if it was opened since the last call."""
        if self._device is not None:
            if self._connection.startswith("tcp:") and now_s > self._received_s + _SILENT_S:
                self._disconnect(TimeoutError(errno.ETIMEDOUT, f"no byte in {_SILENT_S:g} s"))
            return False
        if self._open_thread is None and now_s >= self._next_open_s:
            self._open_thread = threading.Thread(target=self._open, daemon=True)
            self._open_thread.start()
        if not self._open_results:
            return False
        result, self._open_thread = self._open_results.pop(), None
        if isinstance(result, OSError):
            self.error = result.errno or errno.EIO, result.strerror or str(result)
            self._next_open_s, self._pause_s = now_s + self._pause_s, min(2 * self._pause_s, _MAX_PAUSE_S)
            return False
        self._device, self.lost_since_s, self._pause_s = result, None, _FIRST_PAUSE_S
        self._received_s = now_s
        self._buffer.clear()
        return True

    def _open(self) -> None:
        try:
            self._open_results.append(devices.open_device(self._connection))
        except OSError as error:
            self._open_results.append(error)

    def receive(self) -> list[bytes]:
        """Return the frames of the next read; empty if the connection is closed."""
        if self._device is None:
            return []
        try:
            data = self._device.read()
        except OSError as error:
            self._disconnect(error)
            return []
        if data:
            self._received_s = time.monotonic()
        if self._device.has_whole_frames:
            return list(frames(bytearray(data)))
        self._buffer += data
        return list(frames(self._buffer))

    def send(self, frame: bytes) -> None:
        """Send a frame; it is dropped while the connection is closed."""
        if self._device is not None:
            try:
                self._device.write(frame)
            except OSError as error:
                self._disconnect(error)

    def flush(self) -> None:
        """Send queued bytes of a slow line."""
        if self._device is not None:
            try:
                self._device.flush()
            except OSError as error:
                self._disconnect(error)

    def _disconnect(self, error: OSError) -> None:
        self.error = error.errno or errno.EIO, error.strerror or str(error)
        self.close()
        self.lost_since_s = time.monotonic()
        self._next_open_s = 0.0

    def close(self) -> None:
        """Close the connection."""
        if self._device is not None:
            self._device.close()
            self._device = None


class LinkClient:
    """A client of the server.

    Args:
        stream: The socket that is connected to the client.

    Attributes:
        stream: The socket.
        dropped_frames: Number of frames that were dropped because the client was too slow.
    """

    def __init__(self, stream: socket.socket) -> None:
        self.stream = stream
        self.dropped_frames = 0
        stream.setblocking(False)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)

    def send(self, packet: bytes, count: int = 0) -> None:
        """Send a packet with `count` frames. If the buffer of a slow client is full, they are dropped and counted."""
        try:
            self.stream.send(packet)
        except OSError:
            self.dropped_frames += count


class LinkServer:
    """Forwards frames between an autopilot and the programs of fieldkit on its computer.

    Args:
        connection: Name of the connection to the autopilot.
        listener: The socket to which clients connect.
    """

    def __init__(self, connection: str, listener: socket.socket) -> None:
        self._device = SharedDevice(connection)
        self._listener = listener
        self._clients: dict[int, LinkClient] = {}
        self._writer = FrameWriter(*_SERVER_ADDRESS)
        self._intervals = MessageIntervals(self._request)
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._device_descriptor = -1
        self._last_client_s = time.monotonic()

    def run(self, stop_event: threading.Event) -> None:
        """Serve until `_LINGER_S` after the last client has disconnected.

        If `stop_event` is set, the server stops as soon as it has no clients and the message intervals are reset. It
        does not disconnect clients, because they may have a drone in the air.
        """
        while True:
            now_s = time.monotonic()
            if self._clients:
                self._last_client_s = now_s
            elif now_s > self._last_client_s + _LINGER_S or (stop_event.is_set() and self._intervals.settled):
                break
            if self._device.advance(now_s):
                self._intervals.on_reopened()
            self._register_device()
            for key, _ in self._selector.select(_POLL_S):
                self._serve(key.fd)
            self._device.flush()
            self._intervals.advance(time.monotonic())
        self._device.close()

    def _register_device(self) -> None:
        """Register the current descriptor of the device with the selector."""
        if self._device_descriptor == self._device.fileno():
            return
        if self._device_descriptor >= 0:
            self._selector.unregister(self._device_descriptor)
        self._device_descriptor = self._device.fileno()
        if self._device_descriptor >= 0:
            self._selector.register(self._device_descriptor, selectors.EVENT_READ)

    def _serve(self, descriptor: int) -> None:
        if descriptor == self._listener.fileno():
            self._accept()
        elif descriptor == self._device_descriptor:
            self._distribute(self._device.receive())
            self._register_device()  # before another file gets the same descriptor
        elif descriptor in self._clients:
            self._receive_packet(descriptor, self._clients[descriptor])

    def _accept(self) -> None:
        with suppress(OSError):  # the client has disconnected already
            stream, _ = self._listener.accept()
            if link_files.peer_credentials(stream)[1] != os.geteuid() or len(self._clients) >= _MAX_CLIENTS:
                stream.close()
                return
            self._clients[stream.fileno()] = LinkClient(stream)
            self._selector.register(stream, selectors.EVENT_READ)

    def _distribute(self, received_frames: list[bytes]) -> None:
        now_s = time.monotonic()
        for frame in received_frames:
            message = parse_frame(frame)
            source = message.system, message.component
            self._intervals.on_message(source, message.kind, now_s)
            if message.kind == COMMAND_ACK and is_intact(frame):
                self._on_command_ack(source, message, now_s)
        if received_frames:
            packet = FRAMES + b"".join(received_frames)
            for client in self._clients.values():
                client.send(packet, len(received_frames))

    def _on_command_ack(self, source: Target, message: ParsedFrame, now_s: float) -> None:
        command, result, *target = _COMMAND_ACK.unpack(
            message.payload[: _COMMAND_ACK.size].ljust(_COMMAND_ACK.size, b"\0")
        )
        if command == SET_MESSAGE_INTERVAL and tuple(target) in (_SERVER_ADDRESS, (0, 0)):
            self._intervals.on_answer(source, result, now_s)

    def _receive_packet(self, descriptor: int, client: LinkClient) -> None:
        """Process a packet of a client."""
        try:
            packet = client.stream.recv(devices.MAX_BYTES)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self._selector.unregister(client.stream)
            client.stream.close()
            del self._clients[descriptor]
            self._intervals.remove_client(descriptor)
        elif packet[:1] == ALIVE:
            client.send(STATE + json.dumps(self._state(descriptor)).encode())
        elif packet[:1] == FRAMES:
            for frame in frames(bytearray(packet[1:])):
                if not self._intercept_request(descriptor, frame):
                    self._device.send(frame)

    def _intercept_request(self, client: int, frame: bytes) -> bool:
        """Return True if a frame requests a message interval. Such a request is processed here and not forwarded."""
        message = parse_frame(frame)
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
            "left_out": self._clients[client].dropped_frames,
            "messages": self._intervals.report(client, time.monotonic()),
        }


def serve(connection: str, stop_event: threading.Event) -> None:
    """Start a server in a separate process, and return when it is ready or has failed.

    If the connection already has a server, do nothing.

    Raises:
        OSError: The folder of sockets cannot be used.
        ValueError: The name of the connection is invalid.
    """
    devices.check(connection)
    lock = link_files.lock(connection)
    if lock is None:
        return
    ready, notify = os.pipe()
    if os.fork():
        os.close(notify)
        os.read(ready, 1)  # returns at the end of the file: when the server is ready, or has failed
        return
    code = 1
    try:
        os.close(ready)
        _detach(f"{link_files.folder()}/{link_files.name(connection)}.log")
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener, link_files.address(
            connection
        ) as address:
            with suppress(FileNotFoundError):
                os.unlink(address)  # noqa: PTH108 (left by a server that was killed)
            listener.bind(address)
            os.chmod(address, 0o600)  # noqa: PTH101
            listener.listen(_MAX_CLIENTS)
            listener.setblocking(False)
            os.close(notify)
            LinkServer(connection, listener).run(stop_event)
            link_files.remove(connection)  # while the lock is held
        code = 0
    except Exception:  # noqa: BLE001 (the error is logged, and clients start another server)
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _detach(log: str) -> None:
    """Detach from the working folder, the standard files and SIGHUP of the starting client; write errors to a log."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    os.chdir("/")
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1):
        os.dup2(null, descriptor)
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600), 2)
