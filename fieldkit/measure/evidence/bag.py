"""Read the messages of a ROS bag. The only module of fieldkit that reads one."""

import math
import sqlite3
import struct
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from fieldkit.core.errors import EvidenceError

if TYPE_CHECKING:  # whatever loads a procedure knows of bags, but few commands read one: rosbags takes 0.1 s
    from rosbags import rosbag1, rosbag2

METADATA: Final = "metadata.yaml"
"""What a ROS 2 recorder writes beside its file when it closes the bag."""

_ROS2: Final = {".db3", ".mcap"}
_BATTERY: Final = "sensor_msgs/msg/BatteryState"
# A fresh three-cell battery has 12.6 V of nominal 11.1 V.
_MOST_SHARE: Final = 1.5


@cache
def _damage() -> tuple[type[Exception], ...]:
    """Return what rosbags raises for bytes that are no bag."""
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415 (see above)
    from rosbags.highlevel import AnyReaderError  # noqa: PLC0415
    from rosbags.serde import SerdeError  # noqa: PLC0415

    own = (rosbag1.ReaderError, rosbag2.ReaderError, AnyReaderError, SerdeError)
    python = (OSError, ValueError, LookupError, TypeError, AssertionError, MemoryError, sqlite3.Error, struct.error)
    return own + python


@dataclass(frozen=True)
class Bag:
    """Contents of a bag.

    Attributes:
        messages: Number of messages.
        started_utc_ns: Time of the first message, nanoseconds since 1970 UTC by the recorder's clock.
        duration_s: Time from the first message to the last, in seconds.
        messages_by_topic: Number of messages per topic.
    """

    messages: int
    started_utc_ns: int
    duration_s: float
    messages_by_topic: Mapping[str, int]


def read(path: Path) -> Bag:
    """Return what the bag at `path` holds: a ROS 1 bag, or the file of a ROS 2 bag (`.db3`, `.mcap`) in its folder.

    Raises:
        EvidenceError: It is missing, empty, unindexed, cut short, holds no message, or is no bag.
    """
    where = str(path)
    if not path.is_file():
        raise EvidenceError("there is no bag", where=where, remedy="read the recorder's log: did it start?")
    if path.stat().st_size == 0:
        raise EvidenceError("the bag is empty", where=where, remedy="read the recorder's log: was the disk full?")
    from rosbags import rosbag1  # noqa: PLC0415 (see above)

    is_ros2 = path.suffix in _ROS2
    try:
        bag = _ros2(path) if is_ros2 else _contents(rosbag1.Reader(path))
    except _damage() as error:
        tool = "ros2 bag reindex" if is_ros2 else "rosbag reindex"
        raise EvidenceError(
            f"the bag cannot be read, it is unindexed, cut short or none: {error}",
            where=where,
            remedy=f"end the recorder with SIGINT and wait for it, or mend the bag with `{tool}`",
        ) from error
    if bag.messages == 0:
        tool = "ros2 topic hz" if is_ros2 else "rostopic hz"
        raise EvidenceError(
            "the bag holds no message", where=where, remedy=f"does the topic publish? try `{tool} TOPIC`"
        )
    return bag


def battery_share(path: Path, topic: str) -> float | None:
    """Return the charge in the last `sensor_msgs/BatteryState` of `topic`, between 0 and 1; None if it tells none.

    The message says 0 to 1 and NaN for unknown. Some drivers give per cent, and the TurtleBot3 the voltage over the
    nominal one, a little above 1.

    Raises:
        EvidenceError: The bag, which `read` can read, has a message that cannot be read.
    """
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 (see above)
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    share = math.nan
    try:
        # A bag in SQLite does not say what its types are made of.
        types = get_typestore(Stores.ROS2_FOXY)
        with AnyReader([path.parent if path.suffix in _ROS2 else path], default_typestore=types) as reader:
            chosen = [one for one in reader.connections if one.topic == topic and one.msgtype == _BATTERY]
            for connection, _, data in reader.messages(chosen) if chosen else ():
                message: Any = reader.deserialize(data, connection.msgtype)
                share = message.percentage
    except _damage() as error:
        raise EvidenceError(f"a message of {topic} cannot be read: {error}", where=str(path)) from error
    if math.isnan(share) or share < 0:
        return None
    return min(1.0, share if share <= _MOST_SHARE else share / 100)


def _ros2(path: Path) -> Bag:
    """Return what the file holds, if its recorder closed the bag and counted as many messages."""
    from rosbags import rosbag2  # noqa: PLC0415 (see above)

    if not (path.parent / METADATA).is_file():
        raise EvidenceError(
            f"the bag has no {METADATA}: its recorder was killed before it could close the bag",
            where=str(path),
            remedy="end the recorder with SIGINT and wait for it, or mend the bag with `ros2 bag reindex`",
        )
    if path.suffix == ".db3":
        _check_database(path)
    bag, closed = _contents(rosbag2.Reader(path)), _contents(rosbag2.Reader(path.parent))
    if bag.messages != closed.messages:
        raise EvidenceError(
            f"the file holds {bag.messages} messages, {METADATA} counts {closed.messages}",
            where=str(path),
            remedy="is the bag split into several files? leave --max-bag-size and --max-bag-duration out of record",
        )
    return bag


def _check_database(path: Path) -> None:
    """Look at every page: a count of messages can be right where messages are cut off."""
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as database:
        ((said, *_), *_) = database.execute("PRAGMA quick_check(1)")
    if said != "ok":
        raise ValueError(said)


def _contents(reader: "rosbag1.Reader | rosbag2.Reader") -> Bag:
    with reader:
        topics = {topic: info.msgcount for topic, info in reader.topics.items()}
        # rosbags counts to one nanosecond after the last message.
        return Bag(reader.message_count, reader.start_time, (reader.duration - 1) / 1e9, MappingProxyType(topics))
