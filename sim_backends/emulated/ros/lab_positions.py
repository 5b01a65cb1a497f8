"""Shared memory with the positions of all robots of a lab, which the lasers of the robots detect.

The lab writes the positions to anonymous shared memory, which each robot maps read-only before it starts its
programs. Two slots are written alternately, each with its CRC, so that a reader finds a complete slot as soon as
positions have been written once.
"""

import math
import mmap
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.sensor_specs import LaserTarget, Neighbour

_NUMBER: Final = struct.Struct("<Q")
_CRC: Final = struct.Struct("<I")
_AXES: Final = 3
_ABSENT: Final = (math.nan, math.nan, math.nan)


class _Slots:
    """Layout of the two slots for a number of robots: the slot's number, the positions of all robots, the CRC."""

    def __init__(self, robots: int) -> None:
        self.positions = struct.Struct(f"<{_AXES * robots}d")
        self.body_bytes = _NUMBER.size + self.positions.size
        self.slot_bytes = self.body_bytes + _CRC.size


class PositionsWriter:
    """Writes the positions to the memory, in the lab. Call `close` when every robot has stopped.

    Args:
        names: Names of all robots, in the order of `Neighbour.number`.

    Attributes:
        fd: Descriptor of the memory.

    Raises:
        OSError: The memory cannot be allocated.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._slots = _Slots(len(self._names))
        self._number = 0
        self.fd = os.memfd_create("positions")
        os.ftruncate(self.fd, 2 * self._slots.slot_bytes)

    def write(self, positions_m: Mapping[str, Vector]) -> None:
        """Write the position of each antenna, metres east, north, up; robots that are not named have no position.

        Raises:
            OSError: The memory cannot be written.
        """
        self._number += 1
        values = [axis for name in self._names for axis in positions_m.get(name, _ABSENT)]
        body = _NUMBER.pack(self._number) + self._slots.positions.pack(*values)
        os.pwrite(self.fd, body + _CRC.pack(zlib.crc32(body)), self._number % 2 * self._slots.slot_bytes)

    def close(self) -> None:
        """Close the descriptor; mapped memory remains."""
        os.close(self.fd)


class Neighbourhood:
    """Reads the positions from the memory, in a robot.

    Args:
        fd: Descriptor of the memory; the caller closes it.
        robots: Number of robots in the lab.

    Raises:
        OSError: The memory cannot be mapped.
        ValueError: The memory is too small for this number of robots.
    """

    def __init__(self, fd: int, robots: int) -> None:
        self._slots = _Slots(robots)
        self._memory = mmap.mmap(fd, 2 * self._slots.slot_bytes, access=mmap.ACCESS_READ)
        self._number = 0
        self._positions_m = [_ABSENT] * robots

    def targets(self, neighbours: Sequence[Neighbour]) -> list[LaserTarget]:
        """Return the other robots with a position, as laser targets at these positions."""
        self._read()
        targets = []
        for body in neighbours:
            east_m, north_m, up_m = self._positions_m[body.number]
            if not math.isnan(up_m):
                outline_m = ((east_m, north_m),)
                targets.append(LaserTarget(outline_m, body.radius_m, up_m - body.below_m, up_m + body.above_m))
        return targets

    def _read(self) -> None:
        """Read the newest complete slot; if there is no newer slot, keep the last positions."""
        for start in (0, self._slots.slot_bytes):
            slot = self._memory[start : start + self._slots.slot_bytes]
            body, crc = slot[: self._slots.body_bytes], slot[self._slots.body_bytes :]
            (number,) = _NUMBER.unpack_from(body)
            if number > self._number and _CRC.unpack(crc)[0] == zlib.crc32(body):
                self._number = number
                axes = iter(self._slots.positions.unpack_from(body, _NUMBER.size))
                self._positions_m = list(zip(axes, axes, axes, strict=True))  # groups of three axes
