"""Definitions of standard ROS message types that the ROS 1 types of rosbags lack."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

EXTRA_DEFINITIONS: Final[Mapping[str, str]] = MappingProxyType(
    {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}
)
"""Definitions in the format of .msg files, by the name of the type."""
