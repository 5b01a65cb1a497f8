"""Contents of a ROS bag; read in a process of its own, as a bag is what a library of others makes of it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence.confined import Confined, ConfinedAnswerError, Json

METADATA: Final = "metadata.yaml"
"""What a ROS 2 recorder writes beside its file when it closes the bag."""

ROS2: Final = {".db3", ".mcap"}
"""How the files of ROS 2 end."""

# A fresh three-cell battery has 12.6 V of nominal 11.1 V.
_MOST_SHARE: Final = 1.5

_READER: Final = Confined("fieldkit.measure.evidence.bag_reader")

_BLOCK_BYTES: Final = 512  # st_blocks counts these, whatever a file system's own are
_COUNTED_LATE_BYTES: Final = 64 << 20
"""File systems may count the blocks of a file some seconds after it was written; so much is believed at once."""


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
    is_ros2 = path.suffix in ROS2
    if is_ros2 and not (path.parent / METADATA).is_file():
        raise EvidenceError(
            f"the bag has no {METADATA}: its recorder was killed before it could close the bag",
            where=where,
            remedy="end the recorder with SIGINT and wait for it, or mend the bag with `fieldkit bag repair`",
        )
    try:
        found = _asked(path)
    except ConfinedAnswerError as error:
        raise EvidenceError(
            f"the bag cannot be read, it is unindexed, cut short or none: {error}",
            where=where,
            remedy="end the recorder with SIGINT and wait for it, or mend the bag with `fieldkit bag repair`",
        ) from error
    messages, closed = found["messages"], found.get("closed", found["messages"])
    if messages != closed:
        raise EvidenceError(
            f"the file holds {messages} messages, {METADATA} counts {closed}",
            where=where,
            remedy="is the bag split into several files? leave --max-bag-size and --max-bag-duration out of record",
        )
    if messages == 0:
        tool = "ros2 topic hz" if is_ros2 else "rostopic hz"
        raise EvidenceError(
            "the bag holds no message", where=where, remedy=f"does the topic publish? try `{tool} TOPIC`"
        )
    by_topic = MappingProxyType(found["messages_by_topic"])
    return Bag(messages, found["started_utc_ns"], found["duration_s"], by_topic)


@dataclass(frozen=True)
class Heard:
    """What came of one topic.

    Attributes:
        messages: Number of messages.
        first_utc_ns: Time of the first, nanoseconds since 1970 UTC by the recorder's clock.
        last_utc_ns: Time of the last.
        gap_ns: Longest time from one message to the next; 0 where there are no two.
    """

    messages: int
    first_utc_ns: int
    last_utc_ns: int
    gap_ns: int


def heard(path: Path) -> Mapping[str, Heard]:
    """Return what came of each topic in the bag at `path`; of a topic without a message nothing.

    Raises:
        EvidenceError: It is missing or cannot be read.
    """
    if not path.is_file():
        raise EvidenceError("there is no bag", where=str(path), remedy="read the recorder's log: did it start?")
    try:
        found = _asked(path, heard="true")["topics"]
    except ConfinedAnswerError as error:
        raise EvidenceError(f"the bag cannot be read: {error}", where=str(path)) from error
    return {topic: Heard(**one) for topic, one in found.items()}


def battery_share(path: Path, topic: str) -> float | None:
    """Return the charge in the last `sensor_msgs/BatteryState` of `topic`, between 0 and 1; None if it tells none.

    The message says 0 to 1 and NaN for unknown. Some drivers give per cent, and the TurtleBot3 the voltage over the
    nominal one, a little above 1.

    Raises:
        EvidenceError: The bag, which `read` can read, has a message that cannot be read.
    """
    try:
        share: float | None = _asked(path, topic=topic)["share"]
    except ConfinedAnswerError as error:
        raise EvidenceError(f"a message of {topic} cannot be read: {error}", where=str(path)) from error
    if share is None or share < 0:
        return None
    return min(1.0, share if share <= _MOST_SHARE else share / 100)


def positions(path: Path, topic: str, child: str) -> Json:
    """Return what a topic of a bag says of where its robot was; see `bag_reader.positions`.

    Raises:
        EvidenceError: It cannot be read, or its messages say no position.
    """
    try:
        return _asked(path, positions=topic, child=child)
    except ConfinedAnswerError as error:
        raise EvidenceError(f"the positions of {topic} cannot be read: {error}", where=str(path)) from error


def _asked(path: Path, **what: str) -> Json:
    # The reader stays in the folder that it was started in.
    return _READER.ask({"path": str(path.absolute()), **what}, given_bytes(path))


def given_bytes(path: Path) -> int:
    """Return the size by which bounds grow: nobody gave the holes of a file that says it has terabytes."""
    status = path.stat()
    return min(status.st_size, max(_BLOCK_BYTES * status.st_blocks, _COUNTED_LATE_BYTES))
