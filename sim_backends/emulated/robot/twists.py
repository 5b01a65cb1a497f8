"""Velocities for the base of an emulated robot: datagrams of six doubles, as in ROS's `Twist`.

Imports only the standard library, because Debian's Python imports it too.
"""

import struct
from pathlib import Path
from typing import Final

from sim_backends.emulated.robot.spec import STATE

CHANNEL: Final = Path(STATE, "velocities")
"""Socket at which the base receives velocities."""

_TWIST: Final = struct.Struct("<6d")
BYTES: Final = _TWIST.size


def pack(*values: float) -> bytes:
    """Return the datagram for metres per second along x, y, z, and radians per second about them."""
    return _TWIST.pack(*values)


def unpack(words: bytes) -> tuple[float, float] | None:
    """Return forward speed and turn rate to the left, or None if the datagram has the wrong length."""
    if len(words) != BYTES:
        return None
    ahead_m_s, _, _, _, _, turn_rad_s = _TWIST.unpack(words)
    return ahead_m_s, turn_rad_s
