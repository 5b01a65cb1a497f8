"""What the readers of capture files have in common: where the frames of a file stand in it."""

from dataclasses import dataclass
from typing import Final

from fieldkit.measure.arrays import Ints, Table

NO_TIME: Final = -1
"""Time of a frame of which the file tells none."""


@dataclass(frozen=True, eq=False)
class Frames(Table):
    """Frames in the order of the file.

    Attributes:
        start: Index of the first byte of each.
        captured_bytes: How much of it was kept.
        wire_bytes: Its length on the link.
        time_ns: Time of capture, nanoseconds since 1970 UTC; `NO_TIME` where the file tells none.
        link_type: How it begins, by number (https://www.tcpdump.org/linktypes.html).
    """

    start: Ints
    captured_bytes: Ints
    wire_bytes: Ints
    time_ns: Ints
    link_type: Ints


@dataclass(frozen=True)
class Chunk:
    """Some frames that follow each other in a file.

    Attributes:
        frames: They.
        damage: Where and how the file is damaged after them, so that this chunk is the last; None when it is not.
    """

    frames: Frames
    damage: str | None
