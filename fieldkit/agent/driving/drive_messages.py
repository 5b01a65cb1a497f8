"""Messages of a drive, in the serializations of ROS 1 and ROS 2: velocities and odometry.

The base of a robot, which controls its wheels, receives velocities and sends odometry.

ROS 1 has little-endian fields without padding. ROS 2 has CDR (little-endian here): strings end with a zero byte, and
a value is aligned to its size, counted from the end of the encapsulation header.
"""

from __future__ import annotations

import math
import struct

from fieldkit.agent.driving.steering import DriveVelocity, OdometryPose

STAMPED = "geometry_msgs/msg/TwistStamped"
"""Type of velocities with a header; other velocities are of the type `geometry_msgs/msg/Twist`."""

_CDR_HEADER = b"\0\1\0\0"
_TWIST = struct.Struct("<6d")
_POSE = struct.Struct("<7d")
_LENGTH = struct.Struct("<I")
_SEQUENCE = struct.Struct("<I")
_STAMP = struct.Struct("<II")
_MAX_STRING_BYTES = 1 << 16


class VelocityEncoder:
    """Serializes velocities for the topic of a base.

    Args:
        message_type: `STAMPED` for velocities with a header.
        frame: Frame id of the header.
        cdr: True for ROS 2, False for ROS 1.
    """

    def __init__(self, message_type: str, frame: str, *, cdr: bool) -> None:
        self._is_stamped = message_type == STAMPED
        self._frame = frame.encode() + (b"\0" if cdr else b"")
        self._cdr = cdr
        self._sequence = 0

    def encode(self, velocity: DriveVelocity, at_ns: int) -> bytes:
        """Return a serialized velocity.

        Args:
            velocity: The velocity.
            at_ns: Its time by the robot's clock, in nanoseconds since 1970 UTC.
        """
        # linear x, y, z, then angular x, y, z
        values = _TWIST.pack(velocity.forward_m_s, 0.0, 0.0, 0.0, 0.0, velocity.turn_rad_s)
        return (_CDR_HEADER if self._cdr else b"") + (self._header(at_ns) if self._is_stamped else b"") + values

    def _header(self, at_ns: int) -> bytes:
        """Return a `std_msgs/Header` with the padding before the values; ROS 1 numbers the messages from 1."""
        self._sequence += 1
        sequence = b"" if self._cdr else _SEQUENCE.pack(self._sequence)
        header = sequence + _STAMP.pack(*divmod(at_ns, 10**9)) + _LENGTH.pack(len(self._frame)) + self._frame
        return header + (bytes(-len(header) % 8) if self._cdr else b"")


def read_odometry(data: bytes, *, cdr: bool) -> OdometryPose | None:
    """Return the pose in a serialized `nav_msgs/Odometry`; None if the data are invalid or a value is not finite.

    The pose follows a header (in ROS 1 with a sequence number before the time), the frame id of the header and the
    child frame id. Strings follow their length.
    """
    if cdr and data[:4] != _CDR_HEADER:
        return None
    payload = data[4:] if cdr else data
    offset = 8 if cdr else 12
    try:
        for _ in range(2):
            offset += -offset % 4 if cdr else 0
            (length,) = _LENGTH.unpack_from(payload, offset)
            if length > _MAX_STRING_BYTES:
                return None
            offset += 4 + length
        x_m, y_m, _, x, y, z, w = _POSE.unpack_from(payload, offset + (-offset % 8 if cdr else 0))
    except struct.error:
        return None
    if not all(map(math.isfinite, (x_m, y_m, x, y, z, w))):
        return None
    # The heading (yaw) of the orientation, which is a quaternion.
    return OdometryPose(x_m, y_m, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
