"""Pairs of message types of ROS 1 and ROS 2 with the same content, and the conversion of serialized messages.

Most types have the same name and members in both. Time and duration are messages of `std_msgs` in ROS 1 and of
`builtin_interfaces` in ROS 2, with the same two numbers (ros1_bridge maps them in the same way). Since Iron,
`sensor_msgs/Range` has an additional last member: it is 0 in messages from ROS 1, and is removed from messages to
ROS 1.
"""

import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from rosbags.serde import SerdeError

from fieldkit.ros.interfaces.types import MessageTypes, full_name

ROS2_NAMES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "std_msgs/msg/Time": "builtin_interfaces/msg/Time",
        "std_msgs/msg/Duration": "builtin_interfaces/msg/Duration",
    }
)
"""Names in ROS 2 of types with different names in ROS 1 and ROS 2, by the name in ROS 1."""

_ROS1_NAMES: Final = {ros2: ros1 for ros1, ros2 in ROS2_NAMES.items()}

ADDED_MEMBERS: Final[Mapping[str, Mapping[str, bytes]]] = MappingProxyType(
    {"sensor_msgs/msg/Range": {"variance": bytes(4)}}  # a float32; 0 means "unknown" (Range.msg)
)
"""Members that ROS 2 adds at the end of a type, with their bytes in messages from ROS 1."""


@dataclass(frozen=True)
class Counterparts:
    """A type in ROS 1 and in ROS 2.

    Attributes:
        ros1: Its name in ROS 1, for example `std_msgs/msg/Time`.
        ros2: Its name in ROS 2, for example `builtin_interfaces/msg/Time`.
        added_bytes: Bytes that are appended to a message from ROS 1, in the serialization of ROS 1. The same number
            of bytes is removed from the end of a message to ROS 1.
    """

    ros1: str
    ros2: str
    added_bytes: bytes = b""

    def to_ros2(self, types: MessageTypes, data: bytes) -> bytes:
        """Return a message of ROS 1 in CDR.

        Raises:
            SerdeError: The data are not a message of this type.
        """
        with _any_error_as_serde_error(self.ros1):
            return bytes(types.ros2.ros1_to_cdr(data + self.added_bytes, self.ros2))

    def to_ros1(self, types: MessageTypes, data: bytes) -> bytes:
        """Return a CDR message in the serialization of ROS 1.

        Raises:
            SerdeError: The data are not a message of this type.
        """
        with _any_error_as_serde_error(self.ros2):
            converted = bytes(types.ros2.cdr_to_ros1(data, self.ros2))
        if len(converted) < len(self.added_bytes):
            raise SerdeError(f"a message of {self.ros2} has only {len(converted)} bytes")
        return converted[: len(converted) - len(self.added_bytes)]


@contextmanager
def _any_error_as_serde_error(kind: str) -> Iterator[None]:
    """Convert the exceptions that rosbags raises for truncated messages to `SerdeError`.

    rosbags raises `SerdeError` itself only for other invalid messages.
    """
    try:
        yield
    except (ValueError, IndexError, AssertionError, struct.error) as error:
        raise SerdeError(f"the bytes are not a message of {kind}: {error}") from error


def of_type(types: MessageTypes, name: str) -> Counterparts | None:
    """Return the pair of types for a type name of ROS 1 or ROS 2; None if one is missing or their contents differ.

    Raises:
        ConfigurationError: Neither ROS 1 nor ROS 2 has such a type.
    """
    type_name = types.get(full_name(name)).name
    ros1, ros2 = _ROS1_NAMES.get(type_name, type_name), ROS2_NAMES.get(type_name, type_name)
    if ros1 not in types.ros1.fielddefs or ros2 not in types.ros2.fielddefs:
        return None
    if ros1 != ros2 or types.is_translatable(ros2):
        return Counterparts(ros1, ros2)
    added_members = ADDED_MEMBERS.get(ros2, {})
    if added_members and types.adds_at_end(ros2, tuple(added_members)):
        return Counterparts(ros1, ros2, b"".join(added_members.values()))
    return None
