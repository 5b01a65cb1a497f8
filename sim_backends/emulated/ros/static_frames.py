"""Static transforms of an emulated robot: the content of `/tf_static` (REP 105, tf2_ros.StaticTransformBroadcaster).

All its sensors measure at the robot's position, independently of their frame's name, so every transform is the
identity.
"""

import struct
from collections.abc import Iterable, Sequence
from typing import Final

from sim_backends.emulated.ros.sensor_specs import Sensor, packed_string

TOPIC: Final = "/tf_static"
TYPE: Final = "tf2_msgs/TFMessage"
BASE: Final = "base_link"
_FRAMES_OUTSIDE_ROBOT: Final = frozenset({"", "map", "odom", "earth"})
"""Frames of REP 105 that are fixed to the world, and the empty frame of a battery."""

Link = tuple[str, str]
"""Parent frame and child frame."""

_IDENTITY: Final = struct.pack("<7d", *[0.0] * 6, 1.0)


def links(sensors: Iterable[Sensor]) -> tuple[Link, ...]:
    """Return the links from the child frame of odometry via `base_link` to the frames of the sensors.

    The result is empty for a robot whose profile lists `/tf_static` among its topics.
    """
    sensors = tuple(sensors)
    if any(sensor.topic == TOPIC for sensor in sensors):
        return ()
    child_frames = [sensor.child_frame for sensor in sensors if sensor.child_frame]
    base = child_frames[0] if child_frames else BASE
    odometry_frames = (sensor.frame for sensor in sensors if sensor.child_frame)
    excluded_frames = {base, BASE, *_FRAMES_OUTSIDE_ROBOT, *odometry_frames}
    frames = dict.fromkeys(sensor.frame for sensor in sensors if sensor.frame not in excluded_frames)
    base_links = [(base, BASE)] if base != BASE else []
    return (*base_links, *((BASE, frame) for frame in frames))


def message(links: Sequence[Link], stamp_ns: int) -> bytes:
    """Return a `tf2_msgs/TFMessage` with these links in ROS 1 serialization, stamped in ns since the epoch."""
    stamp = struct.pack("<3I", 0, *divmod(stamp_ns, 10**9))
    return struct.pack("<I", len(links)) + b"".join(
        stamp + packed_string(parent) + packed_string(child) + _IDENTITY for parent, child in links
    )
