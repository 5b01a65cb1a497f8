"""Message types of ROS 1 and the types of ROS 2 with the same content, and how the bytes of one become the other's.

Most types have one name and the same members in both. A time and a duration are messages of `std_msgs` in ROS 1 and
of `builtin_interfaces` in ROS 2, with the same two numbers (ros1_bridge maps them likewise). From Iron on
`sensor_msgs/Range` has one member more, at its end: it is 0 for a message from ROS 1, and is lost on the way there.
"""

import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from rosbags.serde import SerdeError

from fieldkit.ros.types import MessageTypes, full_name

ROS2_NAMES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "std_msgs/msg/Time": "builtin_interfaces/msg/Time",
        "std_msgs/msg/Duration": "builtin_interfaces/msg/Duration",
    }
)
"""Types whose name in ROS 2 is another, by that in ROS 1."""

_ROS1_NAMES: Final = {ros2: ros1 for ros1, ros2 in ROS2_NAMES.items()}

ADDED: Final[Mapping[str, Mapping[str, bytes]]] = MappingProxyType(
    {"sensor_msgs/msg/Range": {"variance": bytes(4)}}  # float32, of which 0 is "unknown" (Range.msg)
)
"""Members that ROS 2 adds at the end of a type, with the bytes that they get in a message from ROS 1."""


@dataclass(frozen=True)
class Counterparts:
    """A type in both generations of ROS.

    Attributes:
        ros1: Its name in ROS 1, `std_msgs/msg/Time`.
        ros2: Its name in ROS 2, `builtin_interfaces/msg/Time`.
        added: What a message from ROS 1 gets at its end, as ROS 1 serializes it.
    """

    ros1: str
    ros2: str
    added: bytes = b""

    def to_ros2(self, types: MessageTypes, data: bytes) -> bytes:
        """Return a message of ROS 1 as CDR.

        Raises:
            SerdeError: It is not of the type.
        """
        with _any_error_as_serde_error(self.ros1):
            return bytes(types.ros2.ros1_to_cdr(data + self.added, self.ros2))

    def to_ros1(self, types: MessageTypes, data: bytes) -> bytes:
        """Return a message in CDR as ROS 1 serializes it.

        Raises:
            SerdeError: It is not of the type.
        """
        with _any_error_as_serde_error(self.ros2):
            converted = bytes(types.ros2.cdr_to_ros1(data, self.ros2))
        if len(converted) < len(self.added):
            raise SerdeError(f"a message of {self.ros2} of {len(converted)} bytes")
        return converted[: len(converted) - len(self.added)]


@contextmanager
def _any_error_as_serde_error(kind: str) -> Iterator[None]:
    """Raise what rosbags raises of a message that is cut off as `SerdeError`, as it does of most others."""
    try:
        yield
    except (ValueError, IndexError, AssertionError, struct.error) as error:
        raise SerdeError(f"the bytes are not a message of {kind}: {error}") from error


def of_type(types: MessageTypes, name: str) -> Counterparts | None:
    """Return a type in both generations by its name in either; None where their contents differ.

    Raises:
        ConfigurationError: Neither has such a type.
    """
    full = types.get(full_name(name)).name
    ros1, ros2 = _ROS1_NAMES.get(full, full), ROS2_NAMES.get(full, full)
    if ros1 not in types.ros1.fielddefs or ros2 not in types.ros2.fielddefs:
        return None
    if ros1 != ros2 or types.translatable(ros2):
        return Counterparts(ros1, ros2)
    added = ADDED.get(ros2, {})
    if added and types.adds_at_end(ros2, tuple(added)):
        return Counterparts(ros1, ros2, b"".join(added.values()))
    return None
