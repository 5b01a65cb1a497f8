"""Contents of a ROS bag, which the rosbags library reads in a sandboxed process."""

from pathlib import Path
from types import MappingProxyType
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.core.units import format_count
from fieldkit.measure.evidence.recordings import RecordingContents
from fieldkit.measure.evidence.sandbox import Json, ReaderError, SandboxedReader

METADATA: Final = "metadata.yaml"
"""File that a ROS 2 recorder writes next to its data file when it closes the bag."""

ROS2_SUFFIXES: Final = {".db3", ".mcap"}
"""Suffixes of the data files of ROS 2 bags."""

# A larger value is a percentage. Fractions above 1 occur, because the TurtleBot3 publishes the ratio of the voltage
# to the nominal voltage: 12.6 V / 11.1 V for a full three-cell battery.
_MAX_FRACTION: Final = 1.5

_READER: Final = SandboxedReader("fieldkit.ros.bags.bag_reader")

_BLOCK_BYTES: Final = 512  # unit of st_blocks on every file system
_MIN_ALLOCATED_BYTES: Final = 64 << 20
"""Up to this size, the file size is used, because some file systems update the block count of a file only seconds
after a write."""


def read(path: Path) -> RecordingContents:
    """Return the contents of a bag.

    Args:
        path: A ROS 1 bag, or the data file of a ROS 2 bag (`.db3`, `.mcap`) in its folder.

    Raises:
        EvidenceError: The file is missing, empty, unindexed, truncated, without messages, or not a bag; or it is a
            ROS 2 bag without metadata, or one that is split into several files.
    """
    where = str(path)
    if not path.is_file():
        raise EvidenceError("there is no bag", where=where, remedy="read the recorder's log: did it start?")
    if path.stat().st_size == 0:
        raise EvidenceError("the bag is empty", where=where, remedy="read the recorder's log: was the disk full?")
    is_ros2 = path.suffix in ROS2_SUFFIXES
    if is_ros2 and not (path.parent / METADATA).is_file():
        raise EvidenceError(
            f"the bag has no {METADATA}: its recorder was killed before it closed the bag, or the file was lost",
            where=where,
            remedy="stop the recorder with SIGINT and wait for it, or repair the bag with `fieldkit bag repair`",
        )
    try:
        contents = query(path)
    except ReaderError as error:
        raise EvidenceError(
            f"the bag cannot be read; it is unindexed, truncated or not a bag: {error}",
            where=where,
            remedy="stop the recorder with SIGINT and wait for it, or repair the bag with `fieldkit bag repair`",
        ) from error
    messages, metadata_messages = contents["messages"], contents.get("metadata_messages", contents["messages"])
    if messages != metadata_messages:
        raise EvidenceError(
            f"the file contains {format_count(messages, 'message')}, but {METADATA} states {metadata_messages}",
            where=where,
            remedy="is the bag split into several files? omit --max-bag-size and --max-bag-duration in `record`",
        )
    if messages == 0:
        tool = "ros2 topic hz" if is_ros2 else "rostopic hz"
        raise EvidenceError(
            "the bag contains no message", where=where, remedy=f"does the topic publish? try `{tool} TOPIC`"
        )
    by_topic = MappingProxyType(contents["messages_by_topic"])
    return RecordingContents(messages, contents["started_utc_ns"], contents["duration_s"], by_topic)


def battery_share(path: Path, topic: str) -> float | None:
    """Return the charge in the last `sensor_msgs/BatteryState` of `topic`, between 0 and 1; None if unknown.

    According to its definition the field is 0 to 1, or NaN if unknown. Some drivers write per cent, and the
    TurtleBot3 writes the ratio of voltage to nominal voltage, slightly above 1.

    Raises:
        EvidenceError: The bag or a message in it cannot be read.
    """
    try:
        share: float | None = query(path, topic=topic)["share"]
    except ReaderError as error:
        raise EvidenceError(f"a message of {topic} cannot be read: {error}", where=str(path)) from error
    if share is None or share < 0:
        return None
    return min(1.0, share if share <= _MAX_FRACTION else share / 100)


def positions(path: Path, topic: str, child: str) -> Json:
    """Return the robot positions in the messages of a topic; see `bag_reader.positions`.

    Raises:
        EvidenceError: The bag cannot be read, or the type of its messages contains no position.
    """
    try:
        return query(path, positions=topic, child=child)
    except ReaderError as error:
        raise EvidenceError(f"the positions of {topic} cannot be read: {error}", where=str(path)) from error


def query(path: Path, **parameters: str) -> Json:
    """Return the answer of `bag_reader` to a query about a bag; raises `ReaderError`."""
    # The path must be absolute, because the reader keeps the working directory in which it was started.
    return _READER.query({"path": str(path.absolute()), **parameters}, allocated_bytes(path))


def allocated_bytes(path: Path) -> int:
    """Return the size of a file for the reader's limits.

    For a sparse file above 64 MiB it is the allocated size, at least 64 MiB.
    """
    status = path.stat()
    return min(status.st_size, max(_BLOCK_BYTES * status.st_blocks, _MIN_ALLOCATED_BYTES))
