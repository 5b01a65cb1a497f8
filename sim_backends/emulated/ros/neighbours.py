"""Positions of all robots of a lab in shared memory, for the laser of each robot.

The lab writes them to anonymous shared memory, which each robot maps read-only before it starts its programs. Two
slots are written in turn, each with its CRC, so that a reader always finds a complete one.
"""

import math
import mmap
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.laser import LaserTarget

_NUMBER: Final = struct.Struct("<Q")
_CRC: Final = struct.Struct("<I")
_AXES: Final = 3
_ABSENT: Final = (math.nan, math.nan, math.nan)


class Neighbour(NamedTuple):
    """Body of another robot: an upright cylinder around its antenna.

    Attributes:
        number: Its position among the robots of the lab, from 0.
        radius_m: Radius of the cylinder.
        below_m: How far the cylinder extends below the antenna.
        above_m: How far it extends above the antenna.
    """

    number: int
    radius_m: float
    below_m: float
    above_m: float


class _Slots:
    """Layout of the memory for a number of robots."""

    def __init__(self, robots: int) -> None:
        self.places = struct.Struct(f"<{_AXES * robots}d")
        self.body_bytes = _NUMBER.size + self.places.size
        self.slot_bytes = self.body_bytes + _CRC.size


class PlacesWriter:
    """The lab's end of the memory; call `close` when every robot has stopped.

    Args:
        names: Names of all robots, in the order of `Neighbour.number`.

    Raises:
        OSError: The memory cannot be allocated.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._slots = _Slots(len(self._names))
        self._number = 0
        self.fd = os.memfd_create("places")
        os.ftruncate(self.fd, 2 * self._slots.slot_bytes)

    def write(self, positions_m: Mapping[str, Vector]) -> None:
        """Write the position of each antenna, metres east, north, up; robots that are not named have no place.

        Raises:
            OSError: The memory cannot be written.
        """
        self._number += 1
        values = [axis for name in self._names for axis in positions_m.get(name, _ABSENT)]
        body = _NUMBER.pack(self._number) + self._slots.places.pack(*values)
        os.pwrite(self.fd, body + _CRC.pack(zlib.crc32(body)), self._number % 2 * self._slots.slot_bytes)

    def close(self) -> None:
        """Close the descriptor; mapped memory remains."""
        os.close(self.fd)


class Neighbourhood:
    """A robot's end of the memory.

    Args:
        fd: Descriptor of the memory; the caller closes it.
        robots: Number of robots in the lab.

    Raises:
        OSError: It cannot be mapped.
        ValueError: It is too small for that many robots.
    """

    def __init__(self, fd: int, robots: int) -> None:
        self._slots = _Slots(robots)
        self._memory = mmap.mmap(fd, 2 * self._slots.slot_bytes, access=mmap.ACCESS_READ)
        self._number = 0
        self._places_m = [_ABSENT] * robots

    def targets(self, neighbours: Sequence[Neighbour]) -> list[LaserTarget]:
        """Return the laser targets of other robots at their current positions; those without a place are left out."""
        self._read()
        targets = []
        for body in neighbours:
            east_m, north_m, up_m = self._places_m[body.number]
            if not math.isnan(up_m):
                outline_m = ((east_m, north_m),)
                targets.append(LaserTarget(outline_m, body.radius_m, up_m - body.below_m, up_m + body.above_m))
        return targets

    def _read(self) -> None:
        """Read the newest complete slot; without a newer one the last positions remain."""
        for start in (0, self._slots.slot_bytes):
            slot = self._memory[start : start + self._slots.slot_bytes]
            body, crc = slot[: self._slots.body_bytes], slot[self._slots.body_bytes :]
            (number,) = _NUMBER.unpack_from(body)
            if number > self._number and _CRC.unpack(crc)[0] == zlib.crc32(body):
                self._number = number
                axes = iter(self._slots.places.unpack_from(body, _NUMBER.size))
                self._places_m = list(zip(axes, axes, axes, strict=True))
