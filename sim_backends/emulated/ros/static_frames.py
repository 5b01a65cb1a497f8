"""Frames of an emulated robot that stay where they are on it: what `/tf_static` says (REP 105).

Its sensors measure from where the robot is, whatever their frame is called, so every frame lies in the robot's own.
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
    """Return what joins the frames of sensors to the frame whose motion odometry tells, by way of `base_link`."""
    sensors = tuple(sensors)
    moving = [sensor.child_frame for sensor in sensors if sensor.child_frame]
    base = moving[0] if moving else BASE
    known = {base, BASE, *_WORLDS, *(sensor.frame for sensor in sensors if sensor.child_frame)}
    frames = dict.fromkeys(sensor.frame for sensor in sensors if sensor.frame not in known)
    joined = [(base, BASE)] if base != BASE else []
    return (*joined, *((BASE, frame) for frame in frames))


def message(found: Sequence[Link], stamp_ns: int) -> bytes:
    """Return the message that says so, a `tf2_msgs/TFMessage` as ROS 1 serializes it."""
    stamp = struct.pack("<3I", 0, *divmod(stamp_ns, 10**9))
    return struct.pack("<I", len(found)) + b"".join(
        stamp + packed_string(parent) + packed_string(child) + _IN_PLACE for parent, child in found
    )
