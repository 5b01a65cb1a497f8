"""Quality of service (QoS) that an emulated robot with ROS 2 offers for each topic, in publishers and in bags."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from fieldkit.ros.interfaces.qos import PROFILES, Durability, QosProfile
from sim_backends.emulated.ros import static_frames

BY_TYPE: Final[Mapping[str, QosProfile]] = {
    f"sensor_msgs/{name}": PROFILES["sensor_data"]
    for name in ("LaserScan", "Image", "CompressedImage", "PointCloud2")
}
"""QoS by ROS 1 type, for types with large messages, whose drivers do not use ROS 2's default QoS."""

LATCHED: Final = replace(PROFILES["default"], depth=1, durability=Durability.TRANSIENT_LOCAL)
"""QoS of `/tf_static` (tf2_ros, qos.hpp, StaticBroadcasterQoS)."""

ROSOUT: Final = replace(
    PROFILES["default"], depth=1000, durability=Durability.TRANSIENT_LOCAL, lifespan_ns=10_000_000_000
)
"""QoS of `/rosout` (rcl, logging_rosout.h, rcl_qos_profile_rosout_default)."""


def of_topic(topic: str, kind: str) -> QosProfile:
    """Return the QoS that the publisher of a topic of the ROS 1 type `package/Name` offers."""
    return LATCHED if topic == static_frames.TOPIC else BY_TYPE.get(kind, PROFILES["default"])
