"""Static transforms of an emulated robot: the content of `/tf_static` (REP 105, tf2_ros.StaticTransformBroadcaster).

Its sensors measure from the robot's own position, whatever their frame is called: every transform is the identity.
"""

import struct
from collections.abc import Iterable, Sequence
from typing import Final

from sim_backends.emulated.ros.messages import Sensor, packed_string

TOPIC: Final = "/tf_static"
TYPE: Final = "tf2_msgs/TFMessage"
BASE: Final = "base_link"
_WORLDS: Final = frozenset({"", "map", "odom", "earth"})
"""Those of REP 105 that lie in the world; a battery has none at all."""

Link = tuple[str, str]
"""A frame and one that lies in it."""

_IN_PLACE: Final = struct.pack("<7d", *[0.0] * 6, 1.0)


def links(sensors: Iterable[Sensor]) -> tuple[Link, ...]:
    """Return the links from the frames of sensors to the child frame of odometry, by way of `base_link`.

    Nothing for a robot whose profile lists `/tf_static` among its topics.
    """
    sensors = tuple(sensors)
    if any(sensor.topic == TOPIC for sensor in sensors):
        return ()
    moving = [sensor.child_frame for sensor in sensors if sensor.child_frame]
    base = moving[0] if moving else BASE
    known = {base, BASE, *_WORLDS, *(sensor.frame for sensor in sensors if sensor.child_frame)}
    frames = dict.fromkeys(sensor.frame for sensor in sensors if sensor.frame not in known)
    joined = [(base, BASE)] if base != BASE else []
    return (*joined, *((BASE, frame) for frame in frames))


def message(found: Sequence[Link], stamp_ns: int) -> bytes:
    """Return a `tf2_msgs/TFMessage` with these links, as ROS 1 serializes it, stamped in ns since the epoch."""
    stamp = struct.pack("<3I", 0, *divmod(stamp_ns, 10**9))
    return struct.pack("<I", len(found)) + b"".join(
        stamp + packed_string(parent) + packed_string(child) + _IN_PLACE for parent, child in found
    )
