"""Listener of a recorder, whatever it writes: hears topics until a signal ends it."""

import contextlib
import re
import selectors
import signal
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from sim_backends.emulated.ros import tcpros

_CHUNK: Final = 1 << 16
_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*")

Header = Mapping[str, str]
"""What a publisher says of itself: `topic`, `type`, `md5sum`, `message_definition`, `callerid`, `latching`."""


@dataclass
class _Subscription:
    """One topic that is being heard."""

    topic: str
    stream: socket.socket
    packets: tcpros.PacketSplitter = field(default_factory=tcpros.PacketSplitter)
    header: Header | None = None


class Listener:
    """Hears the topics that it wants from when they are published; SIGINT and SIGTERM end its waits.

    Who speaks something else than TCPROS is heard no more; the others are.

    Attributes:
        wanted: Topics to hear.
        stopped_by: The signal that came, if one has.
    """

    def __init__(self) -> None:
        self.wanted: set[str] = set()
        self.stopped_by: int | None = None
        self._heard: dict[str, _Subscription] = {}
        self._garbled: set[str] = set()
        self._selector = selectors.DefaultSelector()
        self._stop_on_signals()

    def subscribe(self) -> None:
        """Connect to every wanted topic that has a publisher by now."""
        for topic in sorted(self.wanted - self._heard.keys() - self._garbled):
            stream = socket.socket(socket.AF_UNIX)
            try:
                stream.connect(str(tcpros.socket_path(topic)))
            except OSError:
                stream.close()  # nobody publishes it yet
                continue
            with contextlib.suppress(OSError):  # one that has left by now is left when it is read
                stream.sendall(tcpros.request("/record", topic))
            self._heard[topic] = _Subscription(topic, stream)
            self._selector.register(stream, selectors.EVENT_READ, self._heard[topic])

    def leave(self, topic: str) -> None:
        """Hear a topic no more until the next `subscribe`; its publisher may have ended already."""
        if topic in self._heard:
            stream = self._heard.pop(topic).stream
            self._selector.unregister(stream)
            stream.close()

    def events(self, within_s: float) -> Iterator[tuple[Header, bytes | None]]:
        """Yield what arrives next, nothing when it takes longer: None once per publisher, then its messages."""
        for key, _ in self._selector.select(within_s):
            if isinstance(key.data, _Subscription):
                yield from self._take(key.data)

    def _take(self, subscription: _Subscription) -> Iterator[tuple[Header, bytes | None]]:
        data = b""
        with contextlib.suppress(ConnectionResetError):
            data = subscription.stream.recv(_CHUNK)
        if not data:
            self.leave(subscription.topic)
            return
        subscription.packets.feed(data)
        try:
            yield from self._packets(subscription)
        except ValueError:
            self._garbled.add(subscription.topic)
            self.leave(subscription.topic)

    def _packets(self, subscription: _Subscription) -> Iterator[tuple[Header, bytes | None]]:
        """Yield what whole packets say.

        Raises:
            ValueError: One is none, or no header of this topic.
        """
        for payload in subscription.packets:
            if subscription.topic not in self._heard:
                return
            if subscription.header is None:
                subscription.header = _header(payload, subscription.topic)
                yield subscription.header, None
            else:
                yield subscription.header, payload

    def _stop_on_signals(self) -> None:
        ours, signals = socket.socketpair()
        signals.setblocking(False)
        signal.set_wakeup_fd(signals.detach())
        self._selector.register(ours, selectors.EVENT_READ)

        def stop(number: int, _: object) -> None:
            self.stopped_by = number

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])


def _header(payload: bytes, topic: str) -> Header:
    """Return what a publisher says of itself.

    Raises:
        ValueError: It lacks what every publisher says, or is one of another topic.
    """
    header = tcpros.unpack_header(payload)
    lacking = {"topic", "type", "md5sum", "message_definition"} - header.keys()
    if lacking or header["topic"] != topic or not _TYPE.fullmatch(header["type"]):
        raise ValueError(f"no publisher of {topic} says so")
    latching = header.get("latching", "0")
    if latching not in {"0", "1"}:
        raise ValueError(f"latching is {latching!r}")
    return {"callerid": "", **header, "latching": latching}


def type_of(header: Header) -> str:
    """Return the message type of a publisher as rosbags and ROS 2 write it, `package/msg/Name`."""
    return header["type"].replace("/", "/msg/")
