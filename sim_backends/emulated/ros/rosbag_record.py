"""Recorder of topics to a ROS 1 bag: the part of `rosbag record` after the command line is parsed."""

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
from sim_backends.emulated.ros.tcpros import Header, Listener, type_of

# Interval at which the original checks whether it must stop, and whether there are new publishers.
_TICK_S: Final = 0.25


@dataclass(frozen=True)
class Options:
    """Options of a recording.

    Attributes:
        topics: Names of the topics.
        all_topics: Record every published topic.
        prefix: Prefix of the bag's name, before the date; None or empty for none.
        name: Name of the bag; if it is None, the name consists of the prefix (if there is one) and the date.
        duration_s: Stop after this time; None for no limit.
        limit: Stop each topic after this number of messages; 0 for no limit.
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
        """Return the path of the bag."""
        if self.name is not None:
            return Path(self.name.removesuffix(".bag") + ".bag")
        date = datetime.now().astimezone().strftime("%Y-%m-%d-%H-%M-%S")
        return Path(f"{self.prefix}_{date}.bag" if self.prefix else f"{date}.bag")


class RecorderError(Exception):
    """The recorder cannot continue.

    Args:
        text: The error message of the original.

    Attributes:
        line: The message as a line for standard error, with the level and the time.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.line = _console("\x1b[31m[ERROR]", text)


class Rosbag1Recorder:
    """Records until its duration, its limit, SIGINT or SIGTERM; the suffix `.active` marks an incomplete bag.

    Args:
        options: Options of the recording.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._listener = Listener()
        self._message_counts: Counter[str] = Counter()
        self._complete_topics: set[str] = set()

    def run(self) -> None:
        """Record until the recording is complete or stopped.

        Raises:
            RecorderError: The bag cannot be written.
        """
        for topic in self._options.topics:
            self._add_topic(topic)
        bag = self._options.bag()
        active_bag = bag.with_name(f"{bag.name}.active")
        writer = self._open(active_bag)
        _print(f"Recording to '{bag}'.")
        start_ns = time.time_ns()
        while not self._is_over(start_ns):
            if self._options.all_topics:
                for topic in tcpros.topics():
                    if topic not in self._listener.wanted_topics | self._complete_topics:
                        self._add_topic(topic)
            self._listener.subscribe()
            self._write(writer, start_ns)
        writer.close()
        active_bag.rename(bag)

    def _open(self, active_bag: Path) -> Writer:
        active_bag.unlink(missing_ok=True)
        writer = Writer(active_bag)
        writer.chunk_threshold = self._options.chunk_bytes
        try:
            writer.open()
        except OSError as error:
            raise RecorderError(f"Error writing: Error opening file: {active_bag}") from error
        return writer

    def _is_over(self, start_ns: int) -> bool:
        is_limited = bool(self._complete_topics) and not self._listener.wanted_topics and not self._options.all_topics
        return self._listener.stop_signal is not None or is_limited or self._is_past(start_ns, time.time_ns())

    def _is_past(self, start_ns: int, now_ns: int) -> bool:
        duration_s = self._options.duration_s
        return duration_s is not None and now_ns - start_ns > duration_s * 1e9

    def _add_topic(self, topic: str) -> None:
        self._listener.wanted_topics.add(topic)
        _print(f"Subscribing to {topic}")

    def _write(self, writer: Writer, start_ns: int) -> None:
        """Wait at most one tick, and write the messages that have arrived, but none after the end of the duration."""
        for header, message in self._listener.events(_TICK_S):
            connection = _connection(writer, header)
            if message is None:
                continue
            now_ns = time.time_ns()
            if self._is_past(start_ns, now_ns):
                return
            writer.write(connection, now_ns, message)
            self._message_counts[topic := header["topic"]] += 1
            if self._message_counts[topic] == self._options.limit:
                self._complete_topics.add(topic)
                self._listener.wanted_topics.discard(topic)
                self._listener.unsubscribe(topic)


def _connection(writer: Writer, header: Header) -> Connection:
    """Return the bag's connection of a topic; a publisher that connects again gets the same connection."""
    for connection in writer.connections:
        if connection.topic == header["topic"]:
            return connection
    return writer.add_connection(
        header["topic"],
        type_of(header),
        msgdef=header["message_definition"],
        md5sum=header["md5sum"],
        callerid=header["callerid"],
        latching=int(header["latching"]),
    )


def _print(text: str) -> None:
    sys.stdout.write(_console("\x1b[0m[ INFO]", text))


def _console(level: str, text: str) -> str:
    """Return a line in the format of ROS's console: coloured, even if the output is not a terminal."""
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    return f"{level} [{seconds}.{nanoseconds:09d}]: {text}\x1b[0m\n"
