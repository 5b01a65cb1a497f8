"""What a ROS bag holds. The only module of fieldkit that reads one."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from rosbags.rosbag1 import Reader, ReaderError

from fieldkit.errors import EvidenceError


@dataclass(frozen=True)
class Bag:
    """Contents of a bag.

    Attributes:
        messages: Number of messages.
        duration_s: Time from the first message to the last, in seconds.
        messages_by_topic: Number of messages per topic.
    """

    messages: int
    duration_s: float
    messages_by_topic: Mapping[str, int]


def read(path: Path) -> Bag:
    """Return what the ROS 1 bag at `path` holds.

    Raises:
        EvidenceError: It is missing, empty, unindexed, cut short, holds no message, or is no bag.
    """
    where = str(path)
    if not path.is_file():
        raise EvidenceError("there is no bag", where=where, remedy="read the recorder's log: did it start?")
    if path.stat().st_size == 0:
        raise EvidenceError("the bag is empty", where=where, remedy="read the recorder's log: was the disk full?")
    try:
        with Reader(path) as reader:
            topics = {topic: info.msgcount for topic, info in reader.topics.items()}
            messages, duration_ns = reader.message_count, reader.duration
    except (ReaderError, OSError, ValueError, KeyError, AssertionError, struct.error, UnicodeDecodeError) as error:
        raise EvidenceError(
            f"the bag cannot be read, it is unindexed, cut short or no ROS 1 bag: {error}",
            where=where,
            remedy="end the recorder with SIGINT and wait for it, or mend the file with `rosbag reindex`",
        ) from error
    if messages == 0:
        raise EvidenceError(
            "the bag holds no message", where=where, remedy="does the topic publish? try `rostopic hz TOPIC`"
        )
    # rosbags counts to one nanosecond after the last message.
    return Bag(messages, (duration_ns - 1) / 1e9, MappingProxyType(topics))
