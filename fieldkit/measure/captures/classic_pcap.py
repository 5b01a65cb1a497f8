"""Classic pcap files. A scan finds the record boundaries; then the headers of all records are read together.

File format: draft-ietf-opsawg-pcap.
"""

import struct
from collections.abc import Iterator
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Buffer, Chunk, Frames, Integers, Ints, Mask, Order, layout
from fieldkit.measure.captures.headers import check_link_type

MAGIC: Final[dict[bytes, tuple[Order, int]]] = {
    b"\xd4\xc3\xb2\xa1": ("<", 1_000_000),
    b"\xa1\xb2\xc3\xd4": (">", 1_000_000),
    b"\x4d\x3c\xb2\xa1": ("<", 1_000_000_000),
    b"\xa1\xb2\x3c\x4d": (">", 1_000_000_000),
}
"""Byte order and clock ticks per second, by the first four bytes of the file."""

_FILE_HEADER_BYTES: Final = 24
_RECORD_HEADER_BYTES: Final = 16
# After this many records of equal length, the next record probably has this length too.
_MIN_RUN: Final = 16
# libpcap's MAXIMUM_SNAPLEN: no record of a valid file with a supported link type is longer.
_MAX_CAPTURED_BYTES: Final = 262_144


def chunks(data: Buffer, *, where: str, chunk_bytes: int) -> Iterator[Chunk]:
    """Yield the frames of a file in chunks of about `chunk_bytes`; there is at least one chunk.

    Raises:
        EvidenceError: The file ends inside its header, or has an unknown link type.
    """
    size = len(data)
    if size < _FILE_HEADER_BYTES:
        raise EvidenceError("ends inside its header", where=where, remedy="repeat the measurement")
    order, ticks_per_s = MAGIC[bytes(data[:4])]
    # The upper bits of this field contain the length of the frame check sequence.
    link_type = struct.unpack_from(f"{order}I", data, 20)[0] & 0xFFFF
    check_link_type(link_type, where=where)
    integers = Integers(data, order)
    record_header = layout(order, _RECORD_HEADER_BYTES, seconds=(0, 4), ticks=(4, 4), captured=(8, 4), wire=(12, 4))
    at, count, damage = _FILE_HEADER_BYTES, 0, None
    while True:
        starts, at = _scan(data, order, at, min(at + chunk_bytes, size - _RECORD_HEADER_BYTES + 1))
        frames, valid = _frames(integers, record_header, starts, link_type, ticks_per_s)
        if not valid.all():
            frames = frames.where(slice(0, int(valid.argmin())))
            damage = f"no packet header at byte {starts[len(frames)]}, after packet {count + len(frames)}"
        elif at > size:  # the last record extends beyond the end of the file
            frames = frames.where(slice(0, len(frames) - 1))
            damage = f"ends inside the packet at byte {starts[-1]}, after packet {count + len(frames)}"
        elif size - _RECORD_HEADER_BYTES < at < size:  # the file ends inside a record header
            damage = f"ends inside the packet at byte {at}, after packet {count + len(frames)}"
        count += len(frames)
        yield Chunk(frames, damage)
        if damage or at == size:
            return


def _scan(data: Buffer, order: Order, at: int, stop: int) -> tuple[Ints, int]:
    """Return the positions of the records that start from `at` to `stop` (exclusive), and the end of the last one.

    If the packets were truncated to a snap length, most records have the same length. Such records are checked
    together, in groups of growing size.
    """
    captured = struct.Struct(f"{order}I").unpack_from
    parts: list[Ints] = []
    starts: list[int] = []
    step, run_length = 0, 0
    while at < stop:
        starts.append(at)
        previous_step, step = step, _RECORD_HEADER_BYTES + captured(data, at + 8)[0]
        at += step
        run_length = run_length + 1 if step == previous_step else 0
        if run_length >= _MIN_RUN and at < stop:
            equal_count = _equal_length_run(
                data, order, at, step, min(4 * run_length, (stop - at + step - 1) // step)
            )
            parts += [np.array(starts, dtype=np.int64), np.arange(equal_count) * step + at]
            starts = []
            at += equal_count * step
            run_length += equal_count
    return np.concatenate([*parts, np.array(starts, dtype=np.int64)]), at


def _equal_length_run(data: Buffer, order: Order, at: int, step: int, count: int) -> int:
    """Return the number of consecutive records with a length of `step` bytes from `at` on, at most `count`."""
    captured = np.ndarray(count, f"{order}u4", buffer=data, offset=at + 8, strides=(step,))
    has_other_length = captured != step - _RECORD_HEADER_BYTES
    return int(has_other_length.argmax()) if has_other_length.any() else count


def _frames(
    integers: Integers, record_header: np.dtype[np.void], start: Ints, link_type: int, ticks_per_s: int
) -> tuple[Frames, Mask]:
    """Return the frames of the records at the positions `start`, and a mask of the valid record headers."""
    head = integers.fields(record_header, start)
    ticks, captured, wire = head["ticks"], head["captured"], head["wire"]
    frames = Frames(
        start=start + _RECORD_HEADER_BYTES,
        captured_bytes=captured,
        wire_bytes=wire,
        time_ns=head["seconds"] * 1_000_000_000 + ticks * (1_000_000_000 // ticks_per_s),
        link_type=np.full(len(start), link_type),
    )
    # A wire length of 0 is invalid: no link has empty frames, and a power failure leaves zeros in the file.
    valid = (ticks < ticks_per_s) & (captured <= np.minimum(wire, _MAX_CAPTURED_BYTES)) & (wire > 0)
    return frames, valid
