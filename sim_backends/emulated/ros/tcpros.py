"""Subscriber of TCPROS (`sim_backends.ros1.framing`), over a Unix socket per topic.

Only the standard library is imported, because Debian's Python imports this module too.
"""

import contextlib
import re
import selectors
import signal
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sim_backends.ros1.framing import PacketSplitter, pack, pack_header, unpack_header

FOLDER: Final = "/run/ros"
"""Folder of the sockets."""
CALLER: Final = "/sensors"
"""Name of the publisher's node."""


def socket_path(topic: str) -> Path:
    """Return the socket path of `topic`; `.` replaces `/`, since topic names contain no `.`."""
    return Path(FOLDER, topic.strip("/").replace("/", "."))


def topics() -> list[str]:
    """Return the published topics, sorted."""
    folder = Path(FOLDER)
    return sorted("/" + path.name.replace(".", "/") for path in folder.iterdir()) if folder.is_dir() else []


def request(caller: str, topic: str) -> bytes:
    """Return the connection header with which a subscriber requests `topic`, of any type."""
    return pack(pack_header({"callerid": caller, "topic": topic, "md5sum": "*", "type": "*"}))


_CHUNK_BYTES: Final = 1 << 16
_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*")

Header = Mapping[str, str]
"""Connection header of a publisher: `topic`, `type`, `md5sum`, `message_definition`, `callerid`, `latching`."""


@dataclass
class _Subscription:
    """Connection to the publisher of one topic; `header` is None until the publisher's connection header arrives."""

    topic: str
    stream: socket.socket
    packets: PacketSplitter = field(default_factory=PacketSplitter)
    header: Header | None = None


class Listener:
    """Subscribes to wanted topics once they are published; SIGINT and SIGTERM interrupt its waits.

    A publisher that violates TCPROS is disconnected permanently; the other topics continue.

    Attributes:
        wanted_topics: Topics to subscribe to.
        stop_signal: The signal that was received, or None.
    """

    def __init__(self) -> None:
        self.wanted_topics: set[str] = set()
        self.stop_signal: int | None = None
        self._subscriptions: dict[str, _Subscription] = {}
        self._invalid: set[str] = set()
        self._selector = selectors.DefaultSelector()
        self._stop_on_signals()

    def subscribe(self) -> None:
        """Connect to every wanted topic that has a publisher now."""
        for topic in sorted(self.wanted_topics - self._subscriptions.keys() - self._invalid):
            stream = socket.socket(socket.AF_UNIX)
            try:
                stream.connect(str(socket_path(topic)))
            except OSError:
                stream.close()  # it has no publisher yet
                continue
            with contextlib.suppress(OSError):  # a publisher that has exited is detected when the stream is read
                stream.sendall(request("/record", topic))
            self._subscriptions[topic] = _Subscription(topic, stream)
            self._selector.register(stream, selectors.EVENT_READ, self._subscriptions[topic])

    def unsubscribe(self, topic: str) -> None:
        """Disconnect from a topic until the next `subscribe`; does nothing if it is not connected."""
        if topic in self._subscriptions:
            stream = self._subscriptions.pop(topic).stream
            self._selector.unregister(stream)
            stream.close()

    def events(self, within_s: float) -> Iterator[tuple[Header, bytes | None]]:
        """Wait for data or a signal, at most `within_s`; then yield what has arrived.

        Each publisher's connection header is yielded first, as (header, None); then (header, message) per message.
        """
        for key, _ in self._selector.select(within_s):
            if isinstance(key.data, _Subscription):
                yield from self._read(key.data)

    def _read(self, subscription: _Subscription) -> Iterator[tuple[Header, bytes | None]]:
        """Receive data of a subscription, and yield its events."""
        data = b""
        with contextlib.suppress(ConnectionResetError):
            data = subscription.stream.recv(_CHUNK_BYTES)
        if not data:
            self.unsubscribe(subscription.topic)
            return
        subscription.packets.feed(data)
        try:
            yield from self._packets(subscription)
        except ValueError:
            self._invalid.add(subscription.topic)
            self.unsubscribe(subscription.topic)

    def _packets(self, subscription: _Subscription) -> Iterator[tuple[Header, bytes | None]]:
        """Yield the content of complete packets.

        Raises:
            ValueError: A packet is malformed, or the header is not that of a publisher of the topic.
        """
        for payload in subscription.packets:
            if subscription.topic not in self._subscriptions:
                return
            if subscription.header is None:
                subscription.header = _header(payload, subscription.topic)
                yield subscription.header, None
            else:
                yield subscription.header, payload

    def _stop_on_signals(self) -> None:
        """Store SIGINT or SIGTERM in `stop_signal`; a signal also ends the wait of the selector."""
        receiver, signals = socket.socketpair()
        signals.setblocking(False)
        signal.set_wakeup_fd(signals.detach())
        self._selector.register(receiver, selectors.EVENT_READ)

        def stop(number: int, _: object) -> None:
            self.stop_signal = number

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        # `rosbag` blocks the signals before it forks the recorder.
        signal.pthread_sigmask(signal.SIG_SETMASK, [])


def _header(payload: bytes, topic: str) -> Header:
    """Return the connection header of a publisher.

    Raises:
        ValueError: A required field is missing or malformed, or the header is for another topic.
    """
    header = unpack_header(payload)
    missing = {"topic", "type", "md5sum", "message_definition"} - header.keys()
    if missing or header["topic"] != topic or not _TYPE.fullmatch(header["type"]):
        raise ValueError(f"the connection header is not the header of a publisher of {topic}")
    latching = header.get("latching", "0")
    if latching not in {"0", "1"}:
        raise ValueError(f"latching is {latching!r}, not 0 or 1")
    return {"callerid": "", **header, "latching": latching}


def type_of(header: Header) -> str:
    """Return the message type of a publisher in the notation of rosbags, `package/msg/Name`."""
    return header["type"].replace("/", "/msg/")
