"""Frames of a synthetic camera, whose pixels contain the number of the frame and the time at which it was taken.

The upper part of a frame has 16 x 8 cells, black or white, which remain readable after lossy compression. Each cell
is a bit. Row by row, with the most significant bit first, they contain the number (32 bits), the time in nanoseconds
since 1970 UTC (64 bits), and the CRC-32 of both. The lower part, if any, is random, because it determines the size of
the compressed frame.
"""

from __future__ import annotations

import random
import struct
import zlib

COLUMNS, ROWS = 16, 8
BLACK, WHITE = 16, 235
"""Luma of the cells: the limits of the range in ITU-R BT.601, so that no colour conversion clips them."""
MAX_NUMBER = 2**32 - 1

_CONTENT = struct.Struct(">IQ")
_CODE = struct.Struct(">IQI")
_MARGIN = 40
"""The mean luma of a cell must differ by at least this much from the middle of black and white."""


class FrameCode:
    """Writes and reads frames of one size.

    Args:
        width: Pixels per row; a multiple of 16, at least 128.
        height: Rows; `height - noise_rows` must be at least 64.
        noise_rows: Number of random rows at the bottom. If the number of the other rows is not a multiple of 8, up to
            7 of them are random, too.
    """

    def __init__(self, width: int, height: int, noise_rows: int = 0) -> None:
        self._width, self._size = width, width * height
        self._cell_width, self._cell_height = width // COLUMNS, (height - noise_rows) // ROWS
        noise_bytes = width * (height - ROWS * self._cell_height)
        # Twice as many random bytes as needed, so that each frame can use another part of them.
        noise = random.Random(width).getrandbits(16 * noise_bytes or 1).to_bytes(2 * noise_bytes + 1, "little")  # noqa: S311
        self._noise, self._noise_bytes = noise, noise_bytes
        # Offsets of 3 x 3 pixels around the centre of a cell, from its upper left pixel.
        rows, columns = (
            [size * quarter // 4 for quarter in (1, 2, 3)] for size in (self._cell_height, self._cell_width)
        )
        self._samples = [row * width + column for row in rows for column in columns]

    def luma(self, number: int, at_ns: int) -> bytes:
        """Return the luma of a frame, row by row.

        Args:
            number: Number of the frame, at most `MAX_NUMBER`.
            at_ns: Time in nanoseconds since 1970 UTC.
        """
        code = _CODE.pack(number, at_ns, zlib.crc32(_CONTENT.pack(number, at_ns)))
        cells = tuple(bytes([level]) * self._cell_width for level in (BLACK, WHITE))
        parts = []
        for row in range(ROWS):
            (bits,) = struct.unpack_from(">H", code, 2 * row)
            line = b"".join(cells[bits >> (COLUMNS - 1 - column) & 1] for column in range(COLUMNS))
            parts.append(line * self._cell_height)
        # The random pixels differ in each frame, because video encoders transmit only changes. The factor is a prime
        # number, so that consecutive frames start at different offsets.
        start = number * 7919 % (self._noise_bytes + 1)
        return b"".join(parts) + self._noise[start : start + self._noise_bytes]

    def read(self, luma: bytes) -> tuple[int, int] | None:
        """Return the number and the time of a frame; None if it is truncated, or a cell or the CRC-32 is wrong.

        Args:
            luma: The luma of the frame, optionally followed by its other components.
        """
        if len(luma) < self._size:
            return None
        middle, bits = (BLACK + WHITE) / 2, 0
        for row in range(ROWS):
            for column in range(COLUMNS):
                start = row * self._cell_height * self._width + column * self._cell_width
                mean = sum(luma[start + offset] for offset in self._samples) / len(self._samples)
                if abs(mean - middle) < _MARGIN:
                    return None
                bits = bits << 1 | (mean > middle)
        number, at_ns, checksum = _CODE.unpack(bits.to_bytes(_CODE.size, "big"))
        return (number, at_ns) if zlib.crc32(_CONTENT.pack(number, at_ns)) == checksum else None
