"""Topics that a bridge forwards: their notation on the command line, and the counters of each topic."""

import math
import re
from collections import Counter
from dataclasses import dataclass, replace
from typing import Final

from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.ros.interfaces.qos import PROFILES, Durability, History, Policy, QosProfile, Reliability
from fieldkit.ros.interfaces.types import full_name

_POLICIES: Final[dict[str, dict[str, Policy]]] = {
    "reliable": {"reliability": Reliability.RELIABLE},
    "best_effort": {"reliability": Reliability.BEST_EFFORT},
    "keep_all": {"history": History.KEEP_ALL},
    "transient_local": {"durability": Durability.TRANSIENT_LOCAL},
}
_DEPTH: Final = re.compile(r"depth=([1-9]\d{0,5})", re.ASCII)
_NAME: Final = re.compile(r"(/[A-Za-z]\w*)+", re.ASCII)
"""A name that is valid in ROS 1 and ROS 2 (wiki.ros.org/Names; design.ros2.org, "Topic and Service name mapping to
DDS")."""

_LOG_BUCKET_RATIO: Final = math.log(1.01)
"""Natural logarithm of the ratio between adjacent buckets in the histogram of delays: each is 1 % above the previous
one. A histogram needs constant memory, even if a bridge runs for months."""


@dataclass(frozen=True)
class Crossing:
    """A topic that a bridge forwards in one direction.

    Attributes:
        topic: Name, for example `/scan`.
        type_name: Type, for example `sensor_msgs/msg/LaserScan`.
        qos: Its quality of service on both sides.
        back: Whether it is forwarded from the second side to the first.
    """

    topic: str
    type_name: str
    qos: QosProfile
    back: bool = False

    @classmethod
    def parse(cls, text: str, *, back: bool = False) -> "Crossing":
        """Parse a text such as `/scan:sensor_msgs/LaserScan:sensor_data,depth=1`.

        Raises:
            ConfigurationError: The syntax is wrong, or the quality of service does not exist.
        """
        topic, _, type_and_quality = text.partition(":")
        type_name, _, quality = type_and_quality.partition(":")
        if not _NAME.fullmatch(topic) or not type_name:
            raise ConfigurationError(
                f"{text!r} is not a topic with its type", remedy="write it as /scan:sensor_msgs/LaserScan"
            )
        return cls(topic, full_name(type_name), parse_qos(quality), back)


def parse_qos(text: str) -> QosProfile:
    """Parse a quality of service: the name of a profile, then policies, separated by commas; empty for the default.

    Raises:
        ConfigurationError: A profile or policy does not exist.
    """
    words = text.split(",") if text else []
    profile = PROFILES[words.pop(0)] if words and words[0] in PROFILES else PROFILES["default"]
    for word in words:
        if depth := _DEPTH.fullmatch(word):
            profile = replace(profile, history=History.KEEP_LAST, depth=int(depth[1]))
        elif word in _POLICIES:
            profile = replace(profile, **_POLICIES[word])  # type: ignore[arg-type] # each value has the type of its field
        else:
            choices = (*PROFILES, *_POLICIES, "depth=N")
            raise ConfigurationError(
                f"{word!r} is not a quality of service; choose from {', '.join(choices)}",
                remedy=did_you_mean(word, choices, "leave it out for the default of ROS 2"),
            )
    return profile


@dataclass(frozen=True)
class CrossingCounts:
    """Counters of a topic that a bridge forwards in one direction.

    Attributes:
        topic: Its name.
        type: Its type in the spelling of ROS 2.
        source: Middleware of the source.
        target: Middleware of the target.
        messages: Number of messages that were forwarded to the target.
        bytes: Their total size as received.
        refused: Number of messages that the target did not accept in time.
        unreadable: Number of dropped messages that are not valid for the type.
        per_s: Messages per second between the first and the last; None for fewer than two, or if both have the same
            time.
        bytes_per_s: Bytes per second in the same time, without the first message; None if `per_s` is None.
        delay_median_s: Median time from the arrival of a message until the target accepted it; its precision is 1 %.
            None if no message was forwarded.
        delay_p99_s: 99th percentile of this time; its precision is 1 %. None if no message was forwarded.
    """

    topic: str
    type: str
    source: str
    target: str
    messages: int
    bytes: int
    refused: int
    unreadable: int
    per_s: float | None
    bytes_per_s: float | None
    delay_median_s: float | None
    delay_p99_s: float | None


class CrossingTally:
    """Counts forwarded messages. It is not thread-safe."""

    def __init__(self) -> None:
        self.refused = self.unreadable = 0
        self._messages = self._bytes = self._first_bytes = 0
        self._first_ns = self._last_ns = 0
        self._histogram: Counter[int] = Counter()

    def count(self, size_bytes: int, arrived_ns: int, forwarded_ns: int) -> None:
        """Count a forwarded message.

        Args:
            size_bytes: Its size as received.
            arrived_ns: Time of its arrival from the source.
            forwarded_ns: Time at which the target had accepted it, by the same clock.
        """
        if not self._messages:
            self._first_ns, self._first_bytes = forwarded_ns, size_bytes
        self._messages += 1
        self._bytes += size_bytes
        self._last_ns = forwarded_ns
        # If the clock was set back, the delay counts as 1 ns, because 0 has no logarithm.
        self._histogram[round(math.log(max(1, forwarded_ns - arrived_ns)) / _LOG_BUCKET_RATIO)] += 1

    def counts(self, crossing: Crossing, source: str, target: str) -> CrossingCounts:
        """Return the counters."""
        duration_s = (self._last_ns - self._first_ns) / 1e9
        has_rate = duration_s > 0
        return CrossingCounts(
            crossing.topic,
            crossing.type_name,
            source,
            target,
            self._messages,
            self._bytes,
            self.refused,
            self.unreadable,
            (self._messages - 1) / duration_s if has_rate else None,
            (self._bytes - self._first_bytes) / duration_s if has_rate else None,
            self._delay_s(0.5),
            self._delay_s(0.99),
        )

    def _delay_s(self, fraction: float) -> float | None:
        """Return the quantile of the delays for this fraction; None without messages."""
        remaining = math.ceil(fraction * self._messages)
        for bucket in sorted(self._histogram):
            remaining -= self._histogram[bucket]
            if remaining <= 0:
                return math.exp(bucket * _LOG_BUCKET_RATIO) / 1e9
        return None
