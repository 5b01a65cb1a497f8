"""Interface descriptions of pcapng files, and what they make of a packet's time.

File format: draft-ietf-opsawg-pcapng, section 4.2.
"""

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.measure.arrays import Ints, Order

_END_OF_OPTIONS: Final = 0
_RESOLUTION: Final = 9
_OFFSET: Final = 14
_NS: Final = 1_000_000_000
# Up to here the ticks within a second, in nanoseconds, need no more than 64 bits.
_MAX_TICKS_PER_S: Final = 1 << 34


@dataclass(frozen=True)
class Interface:
    """One interface of a section.

    Attributes:
        link_type: How its frames begin (https://www.tcpdump.org/linktypes.html).
        snap_bytes: How much of each frame was kept at most; 0 for all.
        ticks_per_s: Unit of its time stamps.
        offset_s: What to add to them, in seconds.
    """

    link_type: int
    snap_bytes: int
    ticks_per_s: int = 1_000_000
    offset_s: int = 0

    def time_ns(self, ticks: NDArray[np.uint64]) -> Ints:
        """Return time stamps in nanoseconds since 1970 UTC, rounded down."""
        ticks_per_s = self.ticks_per_s
        if ticks_per_s > _MAX_TICKS_PER_S:
            ticks = np.array([tick * _NS // ticks_per_s for tick in ticks.tolist()], dtype=np.uint64)
            ticks_per_s = _NS
        seconds, rest = np.divmod(ticks, np.uint64(ticks_per_s))
        rest_ns = rest * np.uint64(_NS) // np.uint64(ticks_per_s)
        return (seconds.astype(np.int64) + self.offset_s) * _NS + rest_ns.astype(np.int64)


def described(body: bytes, order: Order) -> Interface | None:
    """Return the interface that the body of a block describes, None when it describes none."""
    link_type, _, snap_bytes = struct.unpack_from(f"{order}HHI", body)
    ticks_per_s, offset_s = 1_000_000, 0
    at = 8
    while at + 4 <= len(body):
        code, size = struct.unpack_from(f"{order}HH", body, at)
        value = body[at + 4 : at + 4 + size]
        if code == _END_OF_OPTIONS:
            break
        if len(value) < size:
            return None
        if code == _RESOLUTION and size == 1:
            ticks_per_s = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif code == _OFFSET and size == 8:
            (offset_s,) = struct.unpack(f"{order}q", value)
        at += 4 + (size + 3) // 4 * 4
    return Interface(link_type, snap_bytes, ticks_per_s, offset_s)
