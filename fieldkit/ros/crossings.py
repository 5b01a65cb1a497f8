"""Topics that a bridge carries: how they are written, and what is counted of each."""

import math
import re
from collections import Counter
from dataclasses import dataclass, replace
from typing import Final

from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.ros.qos import PROFILES, Durability, History, Policy, QosProfile, Reliability
from fieldkit.ros.types import full_name

_POLICIES: Final[dict[str, dict[str, Policy]]] = {
    "reliable": {"reliability": Reliability.RELIABLE},
    "best_effort": {"reliability": Reliability.BEST_EFFORT},
    "keep_all": {"history": History.KEEP_ALL},
    "transient_local": {"durability": Durability.TRANSIENT_LOCAL},
}
_DEPTH: Final = re.compile(r"depth=([1-9]\d{0,5})", re.ASCII)
_NAME: Final = re.compile(r"(/[A-Za-z]\w*)+", re.ASCII)
"""A name that both ROS take (wiki.ros.org/Names; design.ros2.org, "Topic and Service name mapping to DDS")."""

_BUCKET: Final = math.log(1.01)
"""Delays are counted in classes that are 1 % wide, so that a bridge may run for months."""


@dataclass(frozen=True)
class Crossing:
    """A topic that is carried one way.

    Attributes:
        topic: `/scan`.
        type_name: `sensor_msgs/msg/LaserScan`.
        qos: Its quality of service on both sides.
        back: Whether it goes from the second side to the first.
    """

    topic: str
    type_name: str
    qos: QosProfile
    back: bool = False

    @classmethod
    def parse(cls, text: str, *, back: bool = False) -> "Crossing":
        """Return what `/scan:sensor_msgs/LaserScan:sensor_data,depth=1` says.

        Raises:
            ConfigurationError: It is not written so, or there is no such quality of service.
        """
        topic, _, rest = text.partition(":")
        type_name, _, quality = rest.partition(":")
        if not _NAME.fullmatch(topic) or not type_name:
            raise ConfigurationError(
                f"{text!r} is no topic and its type", remedy="write it as /scan:sensor_msgs/LaserScan"
            )
        return cls(topic, full_name(type_name), parse_qos(quality), back)


def parse_qos(text: str) -> QosProfile:
    """Return the quality of service that a profile's name and policies say, with commas between; empty: default.

    Raises:
        ConfigurationError: There is no such profile or policy.
    """
    words = text.split(",") if text else []
    found = PROFILES[words.pop(0)] if words and words[0] in PROFILES else PROFILES["default"]
    for word in words:
        if depth := _DEPTH.fullmatch(word):
            found = replace(found, history=History.KEEP_LAST, depth=int(depth[1]))
        elif word in _POLICIES:
            found = replace(found, **_POLICIES[word])  # type: ignore[arg-type] # each by its own field
        else:
            known = (*PROFILES, *_POLICIES, "depth=N")
            raise ConfigurationError(
                f"{word!r} is no quality of service; there are {', '.join(known)}",
                remedy=nearest(word, known, "leave it out for the default of ROS 2"),
            )
    return found


@dataclass(frozen=True)
class Crossed:
    """What a bridge did for a topic one way.

    Attributes:
        topic: Its name.
        type: Its type in the spelling of ROS 2.
        source: Middleware that it came from.
        target: Middleware that it went to.
        messages: Handed to that.
        bytes: Of them, serialized, as they came.
        refused: Messages that the target did not take in time.
        unreadable: Messages that are none of the type, and were dropped.
        per_s: Messages a second between the first and the last; None of fewer than two.
        bytes_per_s: The same of their bytes, without the first.
        delay_median_s: Median time from a message's arrival in this process until the target took it, to 1 %.
        delay_p99_s: The time that 99 % of them took at most, to 1 %.
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
    """Counts what is carried. One thread at a time."""

    def __init__(self) -> None:
        self.refused = self.unreadable = 0
        self._messages = self._bytes = self._first_bytes = 0
        self._first_ns = self._last_ns = 0
        self._classes: Counter[int] = Counter()

    def carried(self, size_bytes: int, arrived_ns: int, left_ns: int) -> None:
        """Count a message."""
        if not self._messages:
            self._first_ns, self._first_bytes = left_ns, size_bytes
        self._messages += 1
        self._bytes += size_bytes
        self._last_ns = left_ns
        # A clock that is set back makes a delay of no time.
        self._classes[round(math.log(max(1, left_ns - arrived_ns)) / _BUCKET)] += 1

    def told(self, crossing: Crossing, source: str, target: str) -> Crossed:
        """Return what was counted."""
        lasted_s = (self._last_ns - self._first_ns) / 1e9
        steady = lasted_s > 0
        return Crossed(
            crossing.topic,
            crossing.type_name,
            source,
            target,
            self._messages,
            self._bytes,
            self.refused,
            self.unreadable,
            (self._messages - 1) / lasted_s if steady else None,
            (self._bytes - self._first_bytes) / lasted_s if steady else None,
            self._delay_s(0.5),
            self._delay_s(0.99),
        )

    def _delay_s(self, share: float) -> float | None:
        """Return the least delay that this share of messages do not exceed."""
        missing = math.ceil(share * self._messages)
        for number in sorted(self._classes):
            missing -= self._classes[number]
            if missing <= 0:
                return math.exp(number * _BUCKET) / 1e9
        return None
