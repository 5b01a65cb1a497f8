"""The `ros2` command of an emulated robot without ROS: `ros2 bag record` writes the bag that ROS 2's own writes.

There is no DDS behind it: it hears the robot's sensors as the built-in `rosbag` does, turns each message into CDR,
and stores it by the rosbag2 plugin asked for, with the quality of service that the publisher offers. Like the
original it has no duration and ends on SIGINT or SIGTERM; options of the original that no trial uses are refused as
unknown.
"""

import argparse
import os
import signal
import sqlite3
import sys
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Final, Literal

from rosbags.convert.converter import migrate_bytes
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from fieldkit.ros.qos import QosProfile
from fieldkit.ros.types import Distribution, MessageTypes
from sim_backends.emulated.ros import offered_qos, tcpros
from sim_backends.emulated.ros.listener import Header, Listener, type_of

# The original looks this often for new publishers.
_TICK_S: Final = 0.1
# rosbag2 writes MCAP unless told otherwise since Iron (ros2/rosbag2#1160).
_SQLITE3_ALONE: Final = {"dashing", "eloquent", "foxy"}
_SQLITE3_IS_DEFAULT: Final = _SQLITE3_ALONE | {"galactic", "humble"}
# Format 9, Jazzy's, has qualities of service as lists with names. An older rosbag2 reads them as text with numbers,
# as in format 8, the oldest that rosbags writes (rosbags.rosbag2.metadata).
_BEFORE_JAZZY: Final = _SQLITE3_IS_DEFAULT | {"iron"}
# Until rosbag2 0.10 the KeyboardInterrupt reached the command line, which made it code 2 (ros2/rosbag2#787).
_SIGINT_IS_2: Final = _SQLITE3_ALONE | {"galactic"}


class Rosbag2Recorder:
    """Records until SIGINT or SIGTERM.

    Args:
        topics: Names; empty for every topic that is published.
        folder: The bag, a folder that does not exist.
        storage: How it is stored.
        distribution: ROS distribution, whose message types are written.
    """

    def __init__(self, topics: Sequence[str], folder: Path, storage: StoragePlugin, distribution: str) -> None:
        self._listener = Listener()
        self._topics = frozenset(topics)
        self._folder = folder
        self._storage = storage
        self._format: Literal[8, 9] = 8 if distribution in _BEFORE_JAZZY else 9
        known = MessageTypes(Distribution.of(distribution))
        self._sensors, self._types = known.ros1, known.ros2
        self._defaults: dict[str, object] = {}
        self._connections: dict[str, Connection] = {}

    def run(self) -> int:
        """Record; return the number of the signal that ended it.

        Raises:
            WriterError: The folder exists.
            OSError: The bag cannot be written.
        """
        listener = self._listener
        with Writer(self._folder, version=self._format, storage_plugin=self._storage) as writer:
            _say("rosbag2_storage", f"Opened database '{_number(writer)}' for READ_WRITE.")
            _say("rosbag2_recorder", "Listening for topics...")
            complete = False
            while listener.stopped_by is None:
                listener.wanted |= self._topics or set(tcpros.topics())
                listener.subscribe()
                for header, message in listener.events(_TICK_S):
                    self._write(writer, header, message)
                if not complete and self._topics and self._connections.keys() >= self._topics:
                    complete = True
                    _say("rosbag2_recorder", "All requested topics are subscribed. Stopping discovery...")
            _say("rosbag2_cpp", "Writing remaining messages from cache to the bag. It may take a while")
        return listener.stopped_by

    def _write(self, writer: Writer, header: Header, message: bytes | None) -> None:
        topic, kind = header["topic"], type_of(header)
        if kind not in self._types.fielddefs or kind not in self._sensors.fielddefs:
            return  # of no package that is installed, which the original says and goes on
        if topic not in self._connections:
            offered = (_discovered(offered_qos.of_topic(topic, header["type"])),)
            self._connections[topic] = writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=offered
            )
            _say("rosbag2_recorder", f"Subscribed to topic '{topic}'")
        if message is not None:
            try:
                data = migrate_bytes(
                    self._sensors, self._types, kind, kind, self._defaults, message, src_is2=False, dst_is2=True
                )
            except Exception:  # noqa: BLE001 (whatever it raises, the publisher's bytes are no such message)
                return
            writer.write(self._connections[topic], time.time_ns(), data)


def _discovered(profile: QosProfile) -> Qos:
    """Return a quality of service as a recorder gets it by DDS: without the history, which DDS does not announce.

    Times that are not limited are RMW_DURATION_INFINITE, and `automatic` is DDS's default liveliness (rmw/types.h).
    """
    endless = QosTime(*divmod(2**63 - 1, 10**9))
    return Qos(
        QosHistory.UNKNOWN,
        0,
        QosReliability[profile.reliability.name],
        QosDurability[profile.durability.name],
        endless,
        endless,
        QosLiveliness.AUTOMATIC,
        endless,
        avoid_ros_namespace_conventions=False,
    )


def _number(writer: Writer) -> Path:
    """Name the bag's file as ROS 2 does, which numbers the files of a bag; return its name."""
    storage = writer.storage
    assert storage is not None
    storage.path = storage.path.rename(storage.path.with_stem(f"{storage.path.stem}_0"))
    if isinstance(storage, Sqlite3Writer):
        # SQLite writes no more into a file that was renamed while it was open.
        storage.conn.close()
        storage.conn = sqlite3.connect(storage.path)
        storage.cursor = storage.conn.cursor()
    return storage.path


def _say(logger: str, text: str) -> None:
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    sys.stderr.write(f"[INFO] [{seconds}.{nanoseconds:09d}] [{logger}]: {text}\n")


def _parser(distribution: str) -> argparse.ArgumentParser:
    alone = distribution in _SQLITE3_ALONE
    parser = argparse.ArgumentParser(prog="ros2", description="ros2 is an extensible command-line tool for ROS 2.")
    commands = parser.add_subparsers(required=True, metavar="command")
    verbs = commands.add_parser("bag", help="Various rosbag related sub-commands").add_subparsers(
        required=True, metavar="verb"
    )
    record = verbs.add_parser("record", help="Record ROS data to a bag")
    record.add_argument("positional", nargs="*", metavar="Topic", help="topics to record")
    record.add_argument("--topics", nargs="+", default=[], metavar="Topic", help="topics to record")
    record.add_argument("-a", "--all", action="store_true", help="record every topic")
    record.add_argument("-o", "--output", help="folder of the bag; else one with the date")
    record.add_argument(
        "-s",
        "--storage",
        default="sqlite3" if distribution in _SQLITE3_IS_DEFAULT else "mcap",
        choices=["sqlite3"] if alone else ["mcap", "sqlite3"],
        metavar="STORAGE" if alone else None,
        help="Storage identifier to be used, defaults to '%(default)s'.",
    )
    return parser


def main(argv: Sequence[str], distribution: str) -> int | str:
    """Run a command line; return its exit code, or what it complains of as the original does, with exit code 1."""
    options = _parser(distribution).parse_args(argv)
    topics = [f"/{topic.lstrip('/')}" for topic in (*options.positional, *options.topics)]
    if bool(topics) is options.all:
        return "[ERROR] [ros2bag]: Need to specify either topics or --all"
    folder = Path(options.output or datetime.now().astimezone().strftime("rosbag2_%Y_%m_%d-%H_%M_%S"))
    if folder.exists():
        return f"[ERROR] [ros2bag]: Output folder '{folder}' already exists."
    try:
        signal_number = Rosbag2Recorder(topics, folder, StoragePlugin[options.storage.upper()], distribution).run()
    except (WriterError, OSError) as error:
        return f"[ERROR] [ros2bag]: {error}"
    return 2 if signal_number == signal.SIGINT and distribution in _SIGINT_IS_2 else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ.get("ROS_DISTRO", "")))
