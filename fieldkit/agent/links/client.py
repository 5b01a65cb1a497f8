"""A client of the link server: it starts the server, and replaces one that was killed or suspended."""

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

from fieldkit.agent.links import devices, places
from fieldkit.agent.links.server import ALIVE, FRAMES, STATE
from fieldkit.agent.mavlink_frames import COMMAND_LONG, SET_MESSAGE_INTERVAL, frames, head

OPENS_S = 3.0
"""A connection that cannot be opened for that long is reported when a client starts; a router restarts in 2 s."""

_ROOT = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", "..", ".."))  # noqa: PTH100, PTH118, PTH120
"""The archive of the agent, or the folder that `fieldkit` is in. The working folder may change later."""
_ASKS_S = 0.1
_SUSPENDED_S = 0.5
_HUNG_S = 2.0
"""A server that does not answer for that long is replaced, also if it is not known to be suspended."""
_STARTS_S = 5.0
_AGAIN_S = 0.1
_BUFFER_BYTES = 1 << 20
_COMMAND_AT, _TARGET_AT = 28, 30


@dataclass(frozen=True)
class MessageRate:
    """What became of the request for a message.

    Attributes:
        interval_us: The interval that the server set for all clients, in microseconds.
        result: MAV_RESULT of the autopilot; None before it answered.
        hz: How often the message came of late.
    """

    interval_us: int
    result: int | None
    hz: float


class SharedLink:
    """A way to an autopilot that other programs share; see `mavlink_links.FlightLink`.

    A thread talks with the server, so that a dead one is replaced also while the program waits for something else.

    Args:
        connection: Its name.

    Attributes:
        lost_since_s: Monotonic time since which nothing can arrive; None while the connection is open.
        left_out: Frames from the autopilot that did not reach this program because it was too slow.
        restarts: How many servers were replaced.
        messages: What became of this program's requests for messages, by their ids.
    """

    def __init__(self, connection: str) -> None:
        self._connection = connection
        self._mine, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (self._mine, self._theirs):
            end.setblocking(False)
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        self._sending = threading.Lock()
        self._server: socket.socket | None = None
        self._requests: dict[tuple[bytes, bytes], bytes] = {}
        self._over = threading.Event()
        self._answered_s = 0.0
        self._refused = self._dropped = self._server_left_out = self._earlier_left_out = 0
        self.lost_since_s: float | None = time.monotonic()
        self.error = (0, "")
        self.failure: OSError | None = None
        self.restarts = 0
        self.messages: Mapping[int, MessageRate] = {}
        self._thread = threading.Thread(target=self._talk, daemon=True)

    @property
    def connected(self) -> bool:
        """Whether the connection to the autopilot is open."""
        return self.lost_since_s is None

    @property
    def left_out(self) -> int:
        """See the class."""
        return self._dropped + self._earlier_left_out + self._server_left_out

    def open(self) -> None:
        """Wait until the connection is open.

        Raises:
            OSError: It cannot be opened within `OPENS_S`.
        """
        self._connect()
        self._thread.start()
        end_s = time.monotonic() + OPENS_S
        while not self.connected:
            if time.monotonic() > end_s:
                self.close()
                raise OSError(*self.error) if self.error[0] else TimeoutError("no link server answers")
            self._over.wait(0.01)

    def fileno(self) -> int:
        """See `FlightLink.fileno`."""
        return self._mine.fileno()

    def receive(self) -> Iterator[bytes]:
        """See `FlightLink.receive`."""
        data = b""
        with suppress(BlockingIOError):
            data = self._mine.recv(devices.MOST_BYTES + 1)
        yield from frames(bytearray(data))

    def send(self, frame: bytes) -> None:
        """See `FlightLink.send`; a request for an interval is kept for the next server."""
        message = head(frame)
        if message.kind == COMMAND_LONG:
            payload = message.payload.ljust(33, b"\0")
            if int.from_bytes(payload[_COMMAND_AT : _COMMAND_AT + 2], "little") == SET_MESSAGE_INTERVAL:
                with self._sending:
                    self._requests[payload[_TARGET_AT : _TARGET_AT + 2], payload[:4]] = frame
        self._send(FRAMES + frame)

    def _send(self, packet: bytes) -> None:
        with self._sending, suppress(
            OSError
        ):  # a dead server is replaced by the thread; on the air frames are lost too
            if self._server is not None:
                self._server.send(packet)

    def close(self) -> None:
        """See `FlightLink.close`."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()
        for end in (self._mine, self._theirs, self._server):
            if end is not None:
                end.close()

    def _talk(self) -> None:
        """Take what the server sends, and replace it when it does not work."""
        asked_s = 0.0
        while not self._over.is_set():
            if self._server is None:
                try:
                    self._connect()
                except OSError as error:
                    self.error = error.errno or 0, str(error)
                    self._over.wait(_AGAIN_S)
                continue
            turned_s = time.monotonic()
            if turned_s >= asked_s + _ASKS_S:
                asked_s = turned_s
                self._send(ALIVE)
            readable, _, _ = select.select([self._server], [], [], _ASKS_S)
            if readable:
                self._take()
            elif time.monotonic() - turned_s > 2 * _ASKS_S:
                self._answered_s = time.monotonic()  # this program itself was suspended
            elif self._is_dead():
                self._end_server()

    def _take(self) -> None:
        assert self._server is not None
        try:
            packet = self._server.recv(devices.MOST_BYTES + 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self._lose()
            return
        self._answered_s = time.monotonic()
        if packet[:1] == FRAMES:
            try:
                self._theirs.send(packet[1:])
            except OSError:
                self._dropped += sum(1 for _ in frames(bytearray(packet[1:])))
        elif packet[:1] == STATE:
            state = json.loads(packet[1:].decode())
            self.error = state["error"][0], state["error"][1]
            self._server_left_out = state["left_out"]
            self.messages = {int(kind): MessageRate(**rate) for kind, rate in state["messages"].items()}
            self.lost_since_s = state["lost_since_s"]

    def _is_dead(self) -> bool:
        """Return whether the server does not answer any more, or is suspended."""
        silent_s = time.monotonic() - self._answered_s
        return silent_s > _HUNG_S or (silent_s > _SUSPENDED_S and self._is_suspended())

    def _is_suspended(self) -> bool:
        assert self._server is not None
        try:
            with open(f"/proc/{places.peer(self._server)[0]}/stat", encoding="utf-8") as file:  # noqa: PTH123
                return file.read().rpartition(")")[2].split()[0] in ("T", "t")
        except (OSError, IndexError):
            return True

    def _end_server(self) -> None:
        """Kill the server. Its socket is open, so its number belongs to no other process."""
        assert self._server is not None
        pid, uid = places.peer(self._server)
        if pid > 1 and uid == os.geteuid():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._lose()

    def _lose(self) -> None:
        with self._sending:
            if self._server is not None:
                self._server.close()
            self._server = None
        self.lost_since_s = self.lost_since_s or time.monotonic()
        self._earlier_left_out += self._server_left_out
        self._server_left_out = 0
        self.restarts += 1

    def _connect(self) -> None:
        """Connect to the server of the connection, and start it if there is no server.

        Raises:
            OSError: It cannot be started.
        """
        end_s = time.monotonic() + _STARTS_S
        while (server := self._reached()) is None:
            self._start()
            if self._over.wait(0.01):
                return
            if time.monotonic() > end_s:
                raise TimeoutError(f"no link server serves {self._connection}")
        with self._sending:
            self._server = server
            self._answered_s = time.monotonic()
            for frame in self._requests.values():
                server.send(FRAMES + frame)
            server.send(ALIVE)

    def _reached(self) -> socket.socket | None:
        """Return a connection to the server; None if there is no server."""
        server = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            with places.address(self._connection) as address:
                server.connect(address)
        except (FileNotFoundError, ConnectionRefusedError, ConnectionResetError):
            server.close()
            return None
        if places.peer(server)[1] != os.geteuid():
            server.close()
            raise PermissionError(f"another user serves {self._connection}")
        server.setblocking(False)
        return server

    def _start(self) -> None:
        """Start a server; return when it serves, or another one does."""
        request = json.dumps({"connection": self._connection})
        path = os.pathsep.join(filter(None, (_ROOT, os.environ.get("PYTHONPATH", ""))))
        done = subprocess.run(
            (sys.executable, "-m", "fieldkit.agent", "link", request),
            env={**os.environ, "PYTHONPATH": path},
            cwd="/",
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            check=False,
        )
        if done.returncode:
            raise OSError(done.stderr.decode("utf-8", "replace").strip()[-300:])
