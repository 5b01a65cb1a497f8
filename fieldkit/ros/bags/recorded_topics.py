"""Discovery time and gaps of recorded topics, from the recorder's log and its bag, which both use the robot's clock.

rosbag of ROS 1 logs `[ INFO] [1795208123.219164628]: Subscribing to /scan` before it queries the master for the
publishers. The recorder of ROS 2 logs `[INFO] [1795208123.219164628] [rosbag2_recorder]: Listening for topics...`
before it starts discovery. The bag has the time of each message by the same clock (recorder.cpp of ros_comm 1.15 and
of rosbag2).
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import reading
from fieldkit.measure.evidence.sandbox import ReaderError
from fieldkit.ros.bags import bag

COLUMNS: Final = columns(
    100,
    (
        "bag_discovered",
        "bool",
        (
            "Whether a message of each recorded topic was received. Without a complete bag it is false if the "
            "recorder did not subscribe to every topic, otherwise empty. Empty without the recorder's log."
        ),
        Figure("topics discovered", Kind.FLAG),
    ),
    (
        "bag_discovery_s",
        "s",
        (
            "Time from the recorder's subscription to the first message, for the slowest topic; it includes "
            "registration, connection and the wait for the message. Empty if no message of a topic was received, or "
            "if the log does not contain the time of the subscription."
        ),
        Figure("discovery", Kind.MEDIAN),
    ),
    (
        "bag_messages",
        "count",
        "Messages of the recorded topics in the bag; empty without a complete bag.",
        Figure("messages recorded", Kind.MEDIAN),
    ),
    (
        "bag_gap_s",
        "s",
        (
            "Longest time without a message of a topic, between its first message and the end of the recording's "
            "duration. Empty if bag_discovery_s is empty."
        ),
        Figure("longest gap between messages", Kind.MEDIAN),
    ),
)

_STAMP: Final = r"\[(?P<s>[0-9]{1,10})\.(?P<ns>[0-9]{9})\]"
_ROS1: Final = re.compile(rf"\[ INFO\] {_STAMP}: Subscribing to (?P<topic>/[A-Za-z0-9_/]+)(?![A-Za-z0-9_/])")
_ROS2: Final = re.compile(rf"\[INFO\] {_STAMP} \[rosbag2_recorder\]: Listening for topics")
_NS: Final = 10**9


@dataclass(frozen=True)
class RecordingReception:
    """Reception of the topics of a recording.

    Attributes:
        discovered: Whether a message of each topic was received; None without a complete bag, unless the recorder did
            not subscribe to every topic: then it is False.
        messages: Number of messages of its topics; None without a complete bag.
        discovery_s: Time from the subscription to the first message, for the slowest topic; None if no message of a
            topic was received, or if the time of the subscription is unknown.
        gap_s: Longest time without a message of a topic from its first message to the end of the recording, in
            seconds; None if `discovery_s` is None.
    """

    discovered: bool | None
    messages: int | None
    discovery_s: float | None
    gap_s: float | None


@dataclass(frozen=True)
class TopicStats:
    """Number and times of the recorded messages of one topic.

    Attributes:
        messages: Number of messages.
        first_utc_ns: Time of the first, nanoseconds since 1970 UTC by the recorder's clock.
        last_utc_ns: Time of the last.
        gap_ns: Longest time between consecutive messages; 0 if there is only one.
    """

    messages: int
    first_utc_ns: int
    last_utc_ns: int
    gap_ns: int


def topic_stats(path: Path) -> Mapping[str, TopicStats]:
    """Return the number and the times of the messages of each topic; topics without a message are omitted.

    Raises:
        EvidenceError: The bag is missing or cannot be read.
    """
    if not path.is_file():
        raise EvidenceError("there is no bag", where=str(path), remedy="read the recorder's log: did it start?")
    try:
        topics = bag.query(path, topic_stats="true")["topics"]
    except ReaderError as error:
        raise EvidenceError(f"the bag cannot be read: {error}", where=str(path)) from error
    return {topic: TopicStats(**fields) for topic, fields in topics.items()}


def read(folder: Path, log: str, file: str, topics: Sequence[str], duration_s: float) -> RecordingReception:
    """Return the reception of the topics of a recording.

    Args:
        folder: The attempt's folder.
        log: Name of the recorder's log.
        file: Name of the bag.
        topics: The recorded topics.
        duration_s: Duration of the recording from the subscription, in seconds.

    Raises:
        EvidenceError: The log is missing.
    """
    start_ns = subscription_ns(reading.text(folder / log), topics)
    is_subscribed_to_all = start_ns.keys() >= set(topics)
    try:
        by_topic = topic_stats(folder / file)
    except EvidenceError:
        # Without a bag, reception is unknown, unless the recorder did not subscribe, for example because it could not
        # connect to its master: then it received no message.
        return RecordingReception(None if is_subscribed_to_all else False, None, None, None)
    discovered = by_topic.keys() >= set(topics)
    messages = sum(by_topic[topic].messages for topic in topics if topic in by_topic)
    if not (discovered and is_subscribed_to_all):
        return RecordingReception(discovered, messages, None, None)
    discovery_times_ns = (by_topic[topic].first_utc_ns - start_ns[topic] for topic in topics)
    ends_ns = {topic: start_ns[topic] + round(duration_s * _NS) for topic in topics}
    gaps_ns = (max(by_topic[topic].gap_ns, ends_ns[topic] - by_topic[topic].last_utc_ns) for topic in topics)
    return RecordingReception(discovered, messages, max(0, *discovery_times_ns) / _NS, max(gaps_ns) / _NS)


def subscription_ns(log: str, topics: Sequence[str]) -> dict[str, int]:
    """Return the time of subscription by topic, from the recorder's log, in nanoseconds since 1970 UTC.

    For ROS 2 it is the start of discovery, which is the same for all topics. Topics whose time is not in the log are
    omitted.
    """
    by_topic = {match["topic"]: _stamp_ns(match) for match in _ROS1.finditer(log)}
    ros2_start = _ROS2.search(log)
    if ros2_start is not None:
        return dict.fromkeys(topics, _stamp_ns(ros2_start))
    return {topic: by_topic[topic] for topic in topics if topic in by_topic}


def _stamp_ns(match: re.Match[str]) -> int:
    return int(match["s"]) * _NS + int(match["ns"])


def measure(reception: RecordingReception | None) -> Measured:
    """Return the columns; `reception` is None without the recorder's log."""
    if reception is None:
        return Measured.all_missing(COLUMNS, "the recorder's log is missing")
    counts = {"bag_discovered": reception.discovered, "bag_messages": reception.messages}
    times = {"bag_discovery_s": reception.discovery_s, "bag_gap_s": reception.gap_s}
    return Measured.from_optional(counts, "there is no complete bag") | Measured.from_optional(
        times, "no message of a topic was received, or the log contains no time"
    )
