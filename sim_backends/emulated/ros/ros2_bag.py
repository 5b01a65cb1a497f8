"""The `ros2` command of an emulated robot without ROS: `ros2 bag record` writes bags as ROS 2 does.

It does not use DDS. It reads the robot's sensors as the built-in `rosbag` does, converts each message to CDR (the
serialization of ROS 2), and stores it with the requested rosbag2 plugin and the quality of service that the publisher
offers. Like the original, it has no option for a duration, and stops on SIGINT or SIGTERM. Options of the original
that no trial uses are rejected as unknown.
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

from fieldkit.ros.interfaces.qos import QosProfile
from fieldkit.ros.interfaces.types import Distribution, MessageTypes
from sim_backends.emulated.ros import offered_qos, tcpros
from sim_backends.emulated.ros.tcpros import Header, Listener, type_of

# Polling interval of the original for new publishers.
_TICK_S: Final = 0.1
# The default format of rosbag2 is MCAP since Iron (ros2/rosbag2#1160).
_SQLITE3_ONLY: Final = {"dashing", "eloquent", "foxy"}
_SQLITE3_IS_DEFAULT: Final = _SQLITE3_ONLY | {"galactic", "humble"}
# Format 9 (Jazzy) stores the QoS profiles as a list with named values. An older rosbag2 expects a text with numbers,
# as in format 8. This is the oldest format that the package rosbags writes (rosbags.rosbag2.metadata).
_BEFORE_JAZZY: Final = _SQLITE3_IS_DEFAULT | {"iron"}
# Until rosbag2 0.10 KeyboardInterrupt reached the command line, which returned exit code 2 (ros2/rosbag2#787).
_SIGINT_EXITS_2: Final = _SQLITE3_ONLY | {"galactic"}


class Rosbag2Recorder:
    """Records until SIGINT or SIGTERM.

    Args:
        topics: Names of the topics; empty for every published topic.
        folder: The bag, a folder that does not exist.
        storage: Storage plugin.
        distribution: ROS distribution, whose message types are written.
    """

    def __init__(self, topics: Sequence[str], folder: Path, storage: StoragePlugin, distribution: str) -> None:
        self._listener = Listener()
        self._topics = frozenset(topics)
        self._folder = folder
        self._storage = storage
        self._format: Literal[8, 9] = 8 if distribution in _BEFORE_JAZZY else 9
        types = MessageTypes(Distribution.of(distribution))
        self._ros1_types, self._ros2_types = types.ros1, types.ros2
        self._defaults: dict[str, object] = {}
        self._connections: dict[str, Connection] = {}
        # Topics for which a message of another type was reported.
        self._reported_topics: set[str] = set()

    def run(self) -> int:
        """Record; return the number of the signal that stopped the recording.

        Raises:
            WriterError: The folder exists.
            OSError: The bag cannot be written.
        """
        listener = self._listener
        with Writer(self._folder, version=self._format, storage_plugin=self._storage) as writer:
            _log("rosbag2_storage", f"Opened database '{_rename_file(writer)}' for READ_WRITE.")
            _log("rosbag2_recorder", "Listening for topics...")
            is_complete = False
            while listener.stop_signal is None:
                listener.wanted_topics |= self._topics or set(tcpros.topics())
                listener.subscribe()
                for header, message in listener.events(_TICK_S):
                    self._write(writer, header, message)
                if not is_complete and self._topics and self._connections.keys() >= self._topics:
                    is_complete = True
                    _log("rosbag2_recorder", "All requested topics are subscribed. Stopping discovery...")
            _log("rosbag2_cpp", "Writing remaining messages from cache to the bag. It may take a while")
        return listener.stop_signal

    def _write(self, writer: Writer, header: Header, message: bytes | None) -> None:
        """Write a message to the bag; a new topic is first added to the bag."""
        topic, kind = header["topic"], type_of(header)
        if kind not in self._ros2_types.fielddefs or kind not in self._ros1_types.fielddefs:
            return  # the package of the type is not installed; the original logs this and continues
        if topic not in self._connections:
            profiles = (_discovered_qos(offered_qos.of_topic(topic, header["type"])),)
            self._connections[topic] = writer.add_connection(
                topic, kind, typestore=self._ros2_types, offered_qos_profiles=profiles
            )
            _log("rosbag2_recorder", f"Subscribed to topic '{topic}'")
        if message is not None:
            try:
                data = migrate_bytes(
                    self._ros1_types,
                    self._ros2_types,
                    kind,
                    kind,
                    self._defaults,
                    message,
                    src_is2=False,
                    dst_is2=True,
                )
            except Exception as error:  # noqa: BLE001 (on any error the publisher's bytes are not a message of this type)
                if topic not in self._reported_topics:
                    self._reported_topics.add(topic)
                    reason = f"{type(error).__name__}: {error}"
                    _log("rosbag2_recorder", f"Messages of topic '{topic}' are not of type '{kind}': {reason}")
                return
            writer.write(self._connections[topic], time.time_ns(), data)


def _discovered_qos(profile: QosProfile) -> Qos:
    """Return a QoS profile as a recorder discovers it by DDS: without the history, which DDS does not announce.

    Unlimited times are RMW_DURATION_INFINITE, and `automatic` is DDS's default liveliness (rmw/types.h).
    """
    infinite = QosTime(*divmod(2**63 - 1, 10**9))
    return Qos(
        QosHistory.UNKNOWN,
        0,
        QosReliability[profile.reliability.name],
        QosDurability[profile.durability.name],
        infinite,
        infinite,
        QosLiveliness.AUTOMATIC,
        infinite,
        avoid_ros_namespace_conventions=False,
    )


def _rename_file(writer: Writer) -> Path:
    """Rename the bag's file as ROS 2 does, which numbers the files of a bag; return its path."""
    storage = writer.storage
    assert storage is not None
    storage.path = storage.path.rename(storage.path.with_stem(f"{storage.path.stem}_0"))
    if isinstance(storage, Sqlite3Writer):
        # SQLite does not write to a file that was renamed while it was open.
        storage.conn.close()
        storage.conn = sqlite3.connect(storage.path)
        storage.cursor = storage.conn.cursor()
    return storage.path


def _log(logger: str, text: str) -> None:
    seconds, nanoseconds = divmod(time.time_ns(), 10**9)
    sys.stderr.write(f"[INFO] [{seconds}.{nanoseconds:09d}] [{logger}]: {text}\n")


def _parser(distribution: str) -> argparse.ArgumentParser:
    sqlite3_only = distribution in _SQLITE3_ONLY
    parser = argparse.ArgumentParser(prog="ros2", description="ros2 is an extensible command-line tool for ROS 2.")
    commands = parser.add_subparsers(required=True, metavar="command")
    verbs = commands.add_parser("bag", help="Various rosbag related sub-commands").add_subparsers(
        required=True, metavar="verb"
    )
    record = verbs.add_parser("record", help="Record ROS data to a bag")
    record.add_argument("positional", nargs="*", metavar="Topic", help="topics to record")
    record.add_argument("--topics", nargs="+", default=[], metavar="Topic", help="topics to record")
    record.add_argument("-a", "--all", action="store_true", help="record every topic")
    record.add_argument("-o", "--output", help="folder of the bag; by default its name has the date")
    record.add_argument(
        "-s",
        "--storage",
        default="sqlite3" if distribution in _SQLITE3_IS_DEFAULT else "mcap",
        choices=["sqlite3"] if sqlite3_only else ["mcap", "sqlite3"],
        metavar="STORAGE" if sqlite3_only else None,
        help="Storage identifier to be used, defaults to '%(default)s'.",
    )
    return parser


def main(argv: Sequence[str], distribution: str) -> int | str:
    """Run a command line; return its exit code, or the original's error message, for exit code 1."""
    options = _parser(distribution).parse_args(argv)
    topics = [f"/{topic.lstrip('/')}" for topic in (*options.positional, *options.topics)]
    if bool(topics) is options.all:  # both were given, or neither
        return "[ERROR] [ros2bag]: Need to specify either topics or --all"
    folder = Path(options.output or datetime.now().astimezone().strftime("rosbag2_%Y_%m_%d-%H_%M_%S"))
    if folder.exists():
        return f"[ERROR] [ros2bag]: Output folder '{folder}' already exists."
    try:
        signal_number = Rosbag2Recorder(topics, folder, StoragePlugin[options.storage.upper()], distribution).run()
    except (WriterError, OSError) as error:
        return f"[ERROR] [ros2bag]: {error}"
    return 2 if signal_number == signal.SIGINT and distribution in _SIGINT_EXITS_2 else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], os.environ.get("ROS_DISTRO", "")))
