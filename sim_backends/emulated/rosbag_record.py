"""Recording topics to a ROS 1 bag: what `rosbag record` does after its options are understood."""

import contextlib
import selectors
import signal
import socket
import sys
import time
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Final

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

from sim_backends.emulated import tcpros

# The original looks this often for its end and for new publishers.
_TICK_S: Final = 0.25
_CHUNK: Final = 1 << 16


@dataclass(frozen=True)
class Options:
    """What to record.

    Attributes:
        topics: Names.
        all_topics: Record every topic that is published.
        prefix: Name the bag by this and the date.
        name: Name the bag; without either, by the date alone.
        duration_s: Stop after this time.
        limit: Stop each topic after so many messages; 0 is no limit.
        chunk_bytes: Size of a chunk of the bag.
    """

    topics: tuple[str, ...]
    all_topics: bool
    prefix: str | None
    name: str | None
    duration_s: float | None
    limit: int
    chunk_bytes: int

    def bag(self) -> Path:
        """Return the file to write."""
        if self.name is not None:
            return Path(self.name.removesuffix(".bag") + ".bag")
        date = datetime.now().astimezone().strftime("%Y-%m-%d-%H-%M-%S")
        return Path(f"{self.prefix}_{date}.bag" if self.prefix else f"{date}.bag")


class RecorderError(Exception):
    """The recorder cannot go on.

    Args:
        what: What the original would say.
    """

    def __init__(self, what: str) -> None:
        super().__init__(what)
        self.line = _console("\x1b[31m[ERROR]", what)


@dataclass
class _Subscription:
    """One topic that is being heard."""

    topic: str
    stream: socket.socket
    packets: tcpros.Packets = field(default_factory=tcpros.Packets)
    connection: Connection | None = None
    messages: int = 0


class Recorder:
    """Records until its duration, its limit, or SIGINT or SIGTERM; the bag is `.active` until it is whole.

    Args:
        options: What to record.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._stopped = False
        self._wanted: set[str] = set()
        self._exhausted: set[str] = set()
        self._selector = selectors.DefaultSelector()

    def run(self) -> None:
        """Record.

        Raises:
            RecorderError: The bag cannot be written.
        """
        self._stop_on_signals()
        for topic in self._options.topics:
            self._want(topic)
        bag = self._options.bag()
        active = bag.with_name(f"{bag.name}.active")
        writer = self._open(active)
        _say(f"Recording to '{bag}'.")
        start_ns = time.time_ns()
        while not self._is_over(start_ns):
            self._subscribe()
            for key, _ in self._selector.select(_TICK_S):
                if isinstance(key.data, _Subscription):
                    self._take(key.data, writer, start_ns)
        writer.close()
        active.rename(bag)

    def _open(self, active: Path) -> Writer:
        active.unlink(missing_ok=True)
        writer = Writer(active)
        writer.chunk_threshold = self._options.chunk_bytes
        try:
            writer.open()
        except OSError as error:
            raise RecorderError(f"Error writing: Error opening file: {active}") from error
        return writer

    def _stop_on_signals(self) -> None:
        """End the wait for messages, too, when a signal comes."""
        ours, signals = socket.socketpair()
        signals.setblocking(False)
        signal.set_wakeup_fd(signals.detach())
        self._selector.register(ours, selectors.EVENT_READ)

        def stop(*_: object) -> None:
            self._stopped = True

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])

    def _is_over(self, start_ns: int) -> bool:
        limit_reached = bool(self._exhausted) and self._exhausted == self._wanted and not self._options.all_topics
        return self._stopped or limit_reached or self._is_past(start_ns, time.time_ns())

    def _is_past(self, start_ns: int, now_ns: int) -> bool:
        duration_s = self._options.duration_s
        return duration_s is not None and now_ns - start_ns > duration_s * 1e9

    def _want(self, topic: str) -> None:
        self._wanted.add(topic)
        _say(f"Subscribing to {topic}")

    def _subscribe(self) -> None:
        """Connect to every wanted topic that has a publisher by now."""
        if self._options.all_topics:
            for topic in tcpros.topics():
                if topic not in self._wanted:
                    self._want(topic)
        heard = {key.data.topic for key in self._selector.get_map().values() if key.data is not None}
        for topic in sorted(self._wanted - heard - self._exhausted):
            stream = socket.socket(socket.AF_UNIX)
            try:
                stream.connect(str(tcpros.socket_path(topic)))
            except OSError:
                stream.close()  # nobody publishes it yet
                continue
            header = {"callerid": "/record", "topic": topic, "md5sum": "*", "type": "*"}
            stream.sendall(tcpros.pack(tcpros.pack_header(header)))
            self._selector.register(stream, selectors.EVENT_READ, _Subscription(topic, stream))

    def _take(self, subscription: _Subscription, writer: Writer, start_ns: int) -> None:
        """Write what arrived for one topic."""
        data = b""
        with contextlib.suppress(ConnectionResetError):
            data = subscription.stream.recv(_CHUNK)
        if not data:
            self._leave(subscription)
            return
        subscription.packets.feed(data)
        for payload in subscription.packets:
            if subscription.connection is None:
                subscription.connection = _connection(writer, subscription.topic, payload)
                continue
            now_ns = time.time_ns()
            if self._is_past(start_ns, now_ns):
                return
            writer.write(subscription.connection, now_ns, payload)
            subscription.messages += 1
            if subscription.messages == self._options.limit:
                self._exhausted.add(subscription.topic)
                self._leave(subscription)
                return

    def _leave(self, subscription: _Subscription) -> None:
        self._selector.unregister(subscription.stream)
        subscription.stream.close()


def _connection(writer: Writer, topic: str, payload: bytes) -> Connection:
    """Return the bag's connection for a publisher's header; the same again after it came back."""
    header = tcpros.unpack_header(payload)
    for known in writer.connections:
        if known.topic == topic:
            return known
    return writer.add_connection(
        topic,
        header["type"].replace("/", "/msg/"),
        msgdef=header["message_definition"],
        md5sum=header["md5sum"],
        callerid=header["callerid"],
        latching=int(header["latching"]),
    )


def _say(text: str) -> None:
    sys.stdout.write(_console("\x1b[0m[ INFO]", text))


def _console(level: str, text: str) -> str:
    """Return a line as ROS's console writes it: coloured, off a terminal too."""
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    return f"{level} [{seconds}.{nanoseconds:09d}]: {text}\x1b[0m\n"
