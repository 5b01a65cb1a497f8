"""A client of the link server: it starts the server, and replaces a server that was killed or suspended."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Iterator, Mapping

from fieldkit.agent.autopilots.mavlink_frames import COMMAND_LONG, SET_MESSAGE_INTERVAL, frames, parse_frame
from fieldkit.agent.links import devices, link_files
from fieldkit.agent.links.server import ALIVE, FRAMES, STATE

OPEN_TIMEOUT_S = 3.0
"""Timeout for opening a connection when a client starts, after the start of its server; a router restarts in 2 s."""

_ROOT = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", "..", ".."))  # noqa: PTH100, PTH118, PTH120
"""The archive of the agent, or the parent folder of `fieldkit`; absolute, because the working folder may change."""
_POLL_S = 0.1
_SUSPENDED_TIMEOUT_S = 0.5
"""A server that does not answer for this time is replaced if it is suspended."""
_TIMEOUT_S = 2.0
"""A server that does not answer for this time is replaced in any case."""
_START_TIMEOUT_S = 15.0
"""Timeout for the start of a server: a busy robot takes seconds to start Python."""
_RETRY_S = 0.1
_BUFFER_BYTES = 1 << 20
_COMMAND_OFFSET, _TARGET_OFFSET = 28, 30
"""Offsets in the payload of COMMAND_LONG: command, and target system and component."""


@dataclass(frozen=True)
class MessageRate:
    """State of the request for a message.

    Attributes:
        interval_us: The interval that the server requests for all clients, in microseconds.
        result: MAV_RESULT of the autopilot; None before its answer.
        hz: Recent rate of the message.
    """

    interval_us: int
    result: int | None
    hz: float


class SharedLink:
    """A connection to an autopilot that other programs share; implements `mavlink_links.FlightLink`.

    A separate thread communicates with the server and replaces a dead server, even while the program is busy.

    Args:
        connection: Name of the connection.

    Attributes:
        lost_since_s: Monotonic time since which the connection is closed; None while it is open.
        error: Number and text of the last error; 0 and an empty text if there was none.
        dropped_frames: Number of frames from the autopilot that were dropped because this program was too slow.
        restarts: Number of servers whose connection to this program has ended.
        messages: State of this program's requests for messages, by message id.
    """

    def __init__(self, connection: str) -> None:
        self._connection = connection
        # The thread writes received frames to `_frames_in`; the program reads them from `_frames_out`.
        self._frames_out, self._frames_in = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for stream in (self._frames_out, self._frames_in):
            stream.setblocking(False)
            stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        self._lock = threading.Lock()
        self._server: socket.socket | None = None
        # The last request for an interval, by the target and the message id in its frame.
        self._requests: dict[tuple[bytes, bytes], bytes] = {}
        self._stop_event = threading.Event()
        self._last_answer_s = 0.0
        self._dropped_by_client = self._dropped_by_server = self._dropped_by_earlier_servers = 0
        self.lost_since_s: float | None = time.monotonic()
        self.error = (0, "")
        self.restarts = 0
        self.messages: Mapping[int, MessageRate] = {}
        self._thread = threading.Thread(target=self._run, daemon=True)

    @property
    def connected(self) -> bool:
        """Whether the connection to the autopilot is open."""
        return self.lost_since_s is None

    @property
    def dropped_frames(self) -> int:
        """Number of frames from the autopilot that were dropped because this program was too slow."""
        return self._dropped_by_client + self._dropped_by_earlier_servers + self._dropped_by_server

    def open(self) -> None:
        """Connect to the link server, and wait until the connection to the autopilot is open.

        Raises:
            OSError: The server cannot be started, or the connection is not open after `OPEN_TIMEOUT_S`.
        """
        self._connect()
        self._thread.start()
        deadline_s = time.monotonic() + OPEN_TIMEOUT_S
        while not self.connected:
            if time.monotonic() > deadline_s:
                self.close()
                raise OSError(*self.error) if self.error[0] else TimeoutError("no link server answers")
            self._stop_event.wait(0.01)

    def fileno(self) -> int:
        """Return a file descriptor that is readable when frames have arrived. A reconnection does not change it."""
        return self._frames_out.fileno()

    def receive(self) -> Iterator[bytes]:
        """Yield the frames of the next packet that has arrived, if any."""
        data = b""
        with suppress(BlockingIOError):
            data = self._frames_out.recv(devices.MAX_BYTES + 1)
        yield from frames(bytearray(data))

    def send(self, frame: bytes) -> None:
        """Send a frame; a request for an interval is stored and repeated to a new server."""
        message = parse_frame(frame)
        if message.kind == COMMAND_LONG:
            payload = message.payload.ljust(33, b"\0")  # MAVLink 2 omits trailing zeros of the 33 bytes
            if int.from_bytes(payload[_COMMAND_OFFSET : _COMMAND_OFFSET + 2], "little") == SET_MESSAGE_INTERVAL:
                with self._lock:
                    self._requests[payload[_TARGET_OFFSET : _TARGET_OFFSET + 2], payload[:4]] = frame
        self._send(FRAMES + frame)

    def _send(self, packet: bytes) -> None:
        # The thread replaces a dead server; callers must tolerate lost frames, as on a radio link.
        with self._lock, suppress(OSError):
            if self._server is not None:
                self._server.send(packet)

    def close(self) -> None:
        """Close the connection, and end all requests for messages."""
        self._stop_event.set()
        if self._thread.is_alive():
            self._thread.join()
        for stream in (self._frames_out, self._frames_in, self._server):
            if stream is not None:
                stream.close()

    def _run(self) -> None:
        """Process packets of the server, and replace a dead server."""
        polled_s = 0.0
        while not self._stop_event.is_set():
            if self._server is None:
                try:
                    self._connect()
                except OSError as error:
                    self.error = error.errno or 0, str(error)
                    self._stop_event.wait(_RETRY_S)
                continue
            iteration_s = time.monotonic()
            if iteration_s >= polled_s + _POLL_S:
                polled_s = iteration_s
                self._send(ALIVE)
            readable, _, _ = select.select([self._server], [], [], _POLL_S)
            if readable:
                self._receive_packet()
            elif time.monotonic() - iteration_s > 2 * _POLL_S:
                self._last_answer_s = time.monotonic()  # this program was suspended, not the server
            elif self._is_dead():
                self._kill_server()

    def _receive_packet(self) -> None:
        assert self._server is not None
        try:
            packet = self._server.recv(devices.MAX_BYTES + 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self._disconnect()
            return
        self._last_answer_s = time.monotonic()
        if packet[:1] == FRAMES:
            try:
                self._frames_in.send(packet[1:])
            except OSError:
                self._dropped_by_client += sum(1 for _ in frames(bytearray(packet[1:])))
        elif packet[:1] == STATE:
            state = json.loads(packet[1:].decode())
            self.error = state["error"][0], state["error"][1]
            self._dropped_by_server = state["left_out"]
            self.messages = {int(kind): MessageRate(**rate) for kind, rate in state["messages"].items()}
            self.lost_since_s = state["lost_since_s"]

    def _is_dead(self) -> bool:
        """Return True if the server has not answered for `_TIMEOUT_S`, or is suspended and does not answer."""
        silent_s = time.monotonic() - self._last_answer_s
        return silent_s > _TIMEOUT_S or (silent_s > _SUSPENDED_TIMEOUT_S and self._is_suspended())

    def _is_suspended(self) -> bool:
        assert self._server is not None
        try:
            with open(f"/proc/{link_files.peer_credentials(self._server)[0]}/stat", encoding="utf-8") as file:  # noqa: PTH123
                return file.read().rpartition(")")[2].split()[0] in ("T", "t")
        except (OSError, IndexError):
            return True  # the process does not exist any more

    def _kill_server(self) -> None:
        """Kill the server. Its end of the socket is still open, so no other process has reused its pid."""
        assert self._server is not None
        pid, uid = link_files.peer_credentials(self._server)
        if pid > 1 and uid == os.geteuid():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._disconnect()

    def _disconnect(self) -> None:
        with self._lock:
            if self._server is not None:
                self._server.close()
            self._server = None
        self.lost_since_s = self.lost_since_s or time.monotonic()
        self._dropped_by_earlier_servers += self._dropped_by_server
        self._dropped_by_server = 0
        self.restarts += 1

    def _connect(self) -> None:
        """Connect to the link server of the connection. If it does not run, it is started.

        Raises:
            OSError: The server cannot be started.
        """
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        while (server := self._try_connect()) is None:
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"the link server of {self._connection} does not start")
            self._start()
            if self._stop_event.wait(0.01):
                return
        with self._lock:
            self._server = server
            self._last_answer_s = time.monotonic()
            for frame in self._requests.values():
                server.send(FRAMES + frame)
            server.send(ALIVE)

    def _try_connect(self) -> socket.socket | None:
        """Return a socket that is connected to the server, or None if no server runs."""
        server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            with link_files.address(self._connection) as address:
                server.connect(address)
        except (FileNotFoundError, ConnectionRefusedError, ConnectionResetError):
            server.close()
            return None
        if link_files.peer_credentials(server)[1] != os.geteuid():
            server.close()
            raise PermissionError(f"the link server of {self._connection} belongs to another user")
        server.setblocking(False)
        return server

    def _start(self) -> None:
        """Start a server, unless the connection has a server; return when it is ready or has failed.

        Raises:
            OSError: The program that starts the server has failed.
        """
        request = json.dumps({"connection": self._connection})
        path = os.pathsep.join(filter(None, (_ROOT, os.environ.get("PYTHONPATH", ""))))
        completed = subprocess.run(
            (sys.executable, "-m", "fieldkit.agent", "link", request),
            env={**os.environ, "PYTHONPATH": path},
            cwd="/",
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            check=False,
        )
        if completed.returncode:
            raise OSError(completed.stderr.decode("utf-8", "replace").strip()[-300:])
