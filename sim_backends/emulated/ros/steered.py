"""Record of the motion of a robot that steers itself, small, for its sensors and the lab to read.

One process of a robot writes: its base controller, or its autopilot. It says where the robot is and how it moves,
with the moment by the monotonic clock, which all processes of a machine share; readers reckon on from there. The
record lies in two slots that are written in turn, each with its sum, so that whoever reads while it is written, or
after its writer was killed, finds the one before.
"""

import math
import os
import struct
import zlib
from pathlib import Path
from typing import Final, NamedTuple, Self

from fieldkit.core.model import Vector
from sim_backends.world.motion import STILL, State

SILENT_NS: Final = 500_000_000
"""A robot that moves says so many times within this; one that says nothing for so long stands."""

_SLOT: Final = struct.Struct("<Q2q11d")
_SUM: Final = struct.Struct("<I")
_SLOT_BYTES: Final = _SLOT.size + _SUM.size


class Steered(NamedTuple):
    """Motion of a robot that steers itself, at one moment.

    Attributes:
        time_ns: The moment, by the monotonic clock.
        way_ns: When the way began (`OwnWay.began_ns`) by which the lab put it where it set out; 0 where it never did.
            What was said of another way is over: the robot was carried off since.
        place_m: Where it is, metres east, north, up.
        velocity_m_s: How it moves, east, north, up.
        heading_rad: Where it faces, from east towards north.
        turn_rad_s: How fast it turns to the left.
        wheels: What its odometry has counted: metres ahead of where it was switched on, metres to the left of that,
            and how far it turned to the left since, in radians.
    """

    time_ns: int
    way_ns: int
    place_m: Vector
    velocity_m_s: Vector = STILL
    heading_rad: float = 0.0
    turn_rad_s: float = 0.0
    wheels: Vector = (0.0, 0.0, 0.0)

    @property
    def speed_m_s(self) -> float:
        """How fast it drives ahead, below 0 for backwards."""
        east, north, _ = self.velocity_m_s
        return east * math.cos(self.heading_rad) + north * math.sin(self.heading_rad)

    @property
    def state(self) -> State:
        """Its place and velocity as the lab knows them."""
        return State(self.place_m, self.velocity_m_s, self.heading_rad)

    @property
    def moves(self) -> bool:
        """Whether it moves or turns."""
        return self.velocity_m_s != STILL or self.turn_rad_s != 0.0

    def at(self, now_ns: int) -> "Steered":
        """Return its motion at a moment after this one by dead reckoning; one that is silent stands."""
        silent = now_ns - self.time_ns >= SILENT_NS
        left_s = min(max(now_ns - self.time_ns, 0), SILENT_NS) / 1e9
        x_m, y_m, yaw_rad = self.wheels
        ahead_m = self.speed_m_s * left_s
        gone = self._replace(
            time_ns=max(now_ns, self.time_ns),
            place_m=_along(self.place_m, self.velocity_m_s, left_s),
            heading_rad=self.heading_rad + self.turn_rad_s * left_s,
            wheels=(
                x_m + ahead_m * math.cos(yaw_rad),
                y_m + ahead_m * math.sin(yaw_rad),
                yaw_rad + self.turn_rad_s * left_s,
            ),
        )
        return gone._replace(velocity_m_s=STILL, turn_rad_s=0.0) if silent else gone


class SteeredRecord:
    """The record, in a file that has one writer and any number of readers.

    Args:
        fd: Descriptor of the file, which is this object's from now on.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._number = 0
        self._last: Steered | None = None
        self.read()

    @classmethod
    def open(cls, path: Path) -> Self:
        """Return the record in a file, which is made where there is none.

        Raises:
            OSError: It cannot be made.
        """
        return cls(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))

    def write(self, motion: Steered) -> None:
        """Say how the robot moves.

        Raises:
            OSError: There is no room for it.
        """
        self._number, self._last = self._number + 1, motion
        slot = _SLOT.pack(
            self._number,
            motion.time_ns,
            motion.way_ns,
            *motion.place_m,
            *motion.velocity_m_s,
            motion.heading_rad,
            motion.turn_rad_s,
            *motion.wheels,
        )
        os.pwrite(self._fd, slot + _SUM.pack(zlib.crc32(slot)), self._number % 2 * _SLOT_BYTES)

    def read(self) -> Steered | None:
        """Return what was said last; None if the robot never steered itself.

        Raises:
            OSError: The file cannot be read.
        """
        said = os.pread(self._fd, 2 * _SLOT_BYTES, 0)
        for begin in (0, _SLOT_BYTES):
            slot, total = said[begin : begin + _SLOT.size], said[begin + _SLOT.size : begin + _SLOT_BYTES]
            if len(total) == _SUM.size and _SUM.unpack(total)[0] == zlib.crc32(slot):
                self._take(*_SLOT.unpack(slot))
        return self._last

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)

    def _take(self, number: int, time_ns: int, way_ns: int, *values: float) -> None:
        if number > self._number:
            place, velocity, wheels = (_vector(values[at : at + 3]) for at in (0, 3, 8))
            heading_rad, turn_rad_s = values[6:8]
            self._number = number
            self._last = Steered(time_ns, way_ns, place, velocity, heading_rad, turn_rad_s, wheels)


def _along(place_m: Vector, velocity_m_s: Vector, for_s: float) -> Vector:
    (east, north, up), (e, n, u) = place_m, velocity_m_s
    return east + e * for_s, north + n * for_s, up + u * for_s


def _vector(values: tuple[float, ...]) -> Vector:
    x, y, z = values
    return x, y, z
