"""Recording topics to a ROS 1 bag: what `rosbag record` does after its options are understood."""

import sys
import time
from collections import Counter
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer

from sim_backends.emulated.ros import tcpros
from sim_backends.emulated.ros.listener import Header, Listener, type_of

# The original looks this often for its end and for new publishers.
_TICK_S: Final = 0.25


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


class Rosbag1Recorder:
    """Records until its duration, its limit, or SIGINT or SIGTERM; the bag is `.active` until it is whole.

    Args:
        options: What to record.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._listener = Listener()
        self._messages: Counter[str] = Counter()
        self._exhausted: set[str] = set()

    def run(self) -> None:
        """Record.

        Raises:
            RecorderError: The bag cannot be written.
        """
        for topic in self._options.topics:
            self._want(topic)
        bag = self._options.bag()
        active = bag.with_name(f"{bag.name}.active")
        writer = self._open(active)
        _say(f"Recording to '{bag}'.")
        start_ns = time.time_ns()
        while not self._is_over(start_ns):
            if self._options.all_topics:
                for topic in tcpros.topics():
                    if topic not in self._listener.wanted | self._exhausted:
                        self._want(topic)
            self._listener.subscribe()
            self._write(writer, start_ns)
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

    def _is_over(self, start_ns: int) -> bool:
        limit_reached = bool(self._exhausted) and not self._listener.wanted and not self._options.all_topics
        return self._listener.stopped_by is not None or limit_reached or self._is_past(start_ns, time.time_ns())

    def _is_past(self, start_ns: int, now_ns: int) -> bool:
        duration_s = self._options.duration_s
        return duration_s is not None and now_ns - start_ns > duration_s * 1e9

    def _want(self, topic: str) -> None:
        self._listener.wanted.add(topic)
        _say(f"Subscribing to {topic}")

    def _write(self, writer: Writer, start_ns: int) -> None:
        """Write what arrives next."""
        for header, message in self._listener.events(_TICK_S):
            connection = _connection(writer, header)
            if message is None:
                continue
            now_ns = time.time_ns()
            if self._is_past(start_ns, now_ns):
                return
            writer.write(connection, now_ns, message)
            self._messages[topic := header["topic"]] += 1
            if self._messages[topic] == self._options.limit:
                self._exhausted.add(topic)
                self._listener.wanted.discard(topic)
                self._listener.leave(topic)


def _connection(writer: Writer, header: Header) -> Connection:
    """Return the bag's connection for a publisher; the same again after it came back."""
    for known in writer.connections:
        if known.topic == header["topic"]:
            return known
    return writer.add_connection(
        header["topic"],
        type_of(header),
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
