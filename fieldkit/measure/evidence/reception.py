"""Reception of a recorder's topics: how soon, and how steadily; by its log and its bag, both by the robot's clock.

ROS 1's rosbag says `[ INFO] [1795208123.219164628]: Subscribing to /scan` before it asks the master who publishes
it, and ROS 2's `[INFO] [1795208123.219164628] [rosbag2_recorder]: Listening for topics...` before it looks for any.
When a message came, a bag says by the same clock (recorder.cpp of ros_comm 1.15 and of rosbag2).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import bag, reading

COLUMNS: Final = columns(
    100,
    (
        "bag_discovered",
        "bool",
        "Whether each topic of the recording brought a message; empty when the recorder left no log or no whole bag.",
        Figure("topics discovered", Kind.FLAG),
    ),
    (
        "bag_discovery_s",
        "s",
        (
            "From the recorder's subscribing to the first message, of the topic that took longest: what registering "
            "and connecting took, and the wait for the message. Empty when a topic brought none, or the log does not "
            "say when that was."
        ),
        Figure("discovery", Kind.MEDIAN),
    ),
    (
        "bag_messages",
        "count",
        "Messages of the recording's topics in the bag; empty when there is no whole bag.",
        Figure("messages recorded", Kind.MEDIAN),
    ),
    (
        "bag_gap_s",
        "s",
        (
            "Longest time without a message of a topic, from its first one to the end of the recording's duration. "
            "Empty as bag_discovery_s."
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
    """How a recording heard its topics.

    Attributes:
        discovered: Whether each topic brought a message; None when nobody knows.
        messages: Messages of its topics; None when there is no whole bag.
        discovery_s: From subscribing to the first message, of the topic that took longest; None when one brought
            none, or nobody knows when it was subscribed to.
        gap_s: Longest time without a message of a topic, in seconds; None as `discovery_s`.
    """

    discovered: bool | None
    messages: int | None
    discovery_s: float | None
    gap_s: float | None


def read(folder: Path, log: str, file: str, topics: Sequence[str], duration_s: float) -> RecordingReception:
    """Return how a recording heard its topics.

    Args:
        folder: The attempt's folder.
        log: The recorder's log in it.
        file: The bag in it.
        topics: What was to be recorded.
        duration_s: For how long, from subscribing on, in seconds.

    Raises:
        EvidenceError: There is no log.
    """
    begun_ns = subscribed_ns(reading.text(folder / log), topics)
    all_begun = begun_ns.keys() >= set(topics)
    try:
        found = bag.heard(folder / file)
    except EvidenceError:
        # One that cannot reach its master never subscribes, and leaves no bag.
        return RecordingReception(None if all_begun else False, None, None, None)
    discovered = found.keys() >= set(topics)
    messages = sum(found[topic].messages for topic in topics if topic in found)
    if not (discovered and all_begun):
        return RecordingReception(discovered, messages, None, None)
    first_ns = (found[topic].first_utc_ns - begun_ns[topic] for topic in topics)
    ends_ns = {topic: begun_ns[topic] + round(duration_s * _NS) for topic in topics}
    gap_ns = (max(found[topic].gap_ns, ends_ns[topic] - found[topic].last_utc_ns) for topic in topics)
    return RecordingReception(discovered, messages, max(0, *first_ns) / _NS, max(gap_ns) / _NS)


def subscribed_ns(log: str, topics: Sequence[str]) -> dict[str, int]:
    """Return when a recorder began to look for each topic that its log tells of, nanoseconds since 1970 UTC."""
    at_ns = {match["topic"]: _stamp_ns(match) for match in _ROS1.finditer(log)}
    everything = _ROS2.search(log)
    if everything is not None:
        return dict.fromkeys(topics, _stamp_ns(everything))
    return {topic: at_ns[topic] for topic in topics if topic in at_ns}


def _stamp_ns(match: re.Match[str]) -> int:
    return int(match["s"]) * _NS + int(match["ns"])


def measure(found: RecordingReception | None) -> Measured:
    """Return the columns; None where the evidence does not tell."""
    if found is None:
        return Measured.nothing(COLUMNS, "the recorder left no log")
    counts = {"bag_discovered": found.discovered, "bag_messages": found.messages}
    times = {"bag_discovery_s": found.discovery_s, "bag_gap_s": found.gap_s}
    return Measured.of(counts, "there is no whole bag") | Measured.of(
        times, "a topic brought no message, or the log says no time"
    )
