"""Frames as messages `sensor_msgs/Image`, serialized for ROS 1 and in CDR.

The first pixels of a frame are replaced by the head of a sample (`fieldkit.agent.messaging.stream`), so that the head
is found in captures. A receiver reads the cells of the frame, not the head.
"""

from __future__ import annotations

import struct

from fieldkit.agent.video.frame_code import FrameCode

_FRAME_ID = b"camera\0"
_ENCODING = b"mono8\0"

# Header (stamp, frame_id), height, width, encoding, is_bigendian, step, length of the data. Strings of ROS 1 have no
# terminator, and CDR aligns to 4 bytes after its own header.
_ROS1 = struct.Struct("<IIII6sIII5sBII")
_CDR = struct.Struct("<4siII7sxIII6sBxII")
_CDR_HEADER = b"\0\1\0\0"


class ImageCodec:
    """Encodes and decodes frames as messages.

    Args:
        width: Pixels per row.
        height: Rows.
        ros1: Whether the messages are of ROS 1.
    """

    def __init__(self, width: int, height: int, *, ros1: bool) -> None:
        self._code, self._ros1 = FrameCode(width, height), ros1
        self._width, self._height = width, height
        self._envelope_bytes = (_ROS1 if ros1 else _CDR).size

    def encode(self, sequence: int, at_ns: int, head: bytes) -> bytes:
        """Return the message of a frame that was taken at `at_ns`, with `head` in place of its first pixels."""
        luma = self._code.luma(sequence, at_ns)
        return self._envelope(sequence, at_ns) + head + luma[len(head) :]

    def decode(self, data: bytes) -> tuple[int, int] | None:
        """Return the number and the time in the pixels; None if the size is wrong or the pixels are not readable."""
        padding_bytes = len(data) - self._envelope_bytes - self._width * self._height
        # Some implementations pad CDR to a multiple of 4 bytes and do not indicate this in the header.
        return self._code.read(data[self._envelope_bytes :]) if 0 <= padding_bytes < 4 else None

    def _envelope(self, sequence: int, at_ns: int) -> bytes:
        """Return the bytes before the pixels."""
        seconds, nanoseconds = divmod(at_ns, 1_000_000_000)
        size, width, height = self._width * self._height, self._width, self._height
        if self._ros1:
            frame_id, encoding = _FRAME_ID[:-1], _ENCODING[:-1]
            stamp = (sequence & 0xFFFF_FFFF, seconds, nanoseconds, len(frame_id), frame_id)
            return _ROS1.pack(*stamp, height, width, len(encoding), encoding, 0, width, size)
        stamp_cdr = (_CDR_HEADER, seconds, nanoseconds, len(_FRAME_ID), _FRAME_ID)
        return _CDR.pack(*stamp_cdr, height, width, len(_ENCODING), _ENCODING, 0, width, size)
