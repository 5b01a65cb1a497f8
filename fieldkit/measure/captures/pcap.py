"""Capture files, pcap and pcapng: their IP packets as columns, for the whole file or in chunks.

Classic pcap files are scanned for the record boundaries, then all headers are read together.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from mmap import MADV_DONTNEED, mmap
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import pcapng
from fieldkit.measure.captures.arrays import Buffer, Chunk, Frames, Integers, Ints, Mask, Order, layout
from fieldkit.measure.captures.headers import check_link_type
from fieldkit.measure.captures.packets import Packets, decode
from fieldkit.measure.evidence import reading

CLASSIC_MAGIC: Final[dict[bytes, tuple[Order, int]]] = {
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
# libpcap's MAXIMUM_SNAPLEN: no record of a valid file is longer.
_MAX_CAPTURED_BYTES: Final = 262_144


def classic_chunks(data: Buffer, *, where: str, chunk_bytes: int) -> Iterator[Chunk]:
    """Yield the frames of a file in chunks of about `chunk_bytes`; at least one chunk.

    Raises:
        EvidenceError: The file ends inside its header, or has an unknown link type.
    """
    size = len(data)
    if size < _FILE_HEADER_BYTES:
        raise EvidenceError("ends inside its header", where=where, remedy="repeat the measurement")
    order, ticks_per_s = CLASSIC_MAGIC[bytes(data[:4])]
    # The upper bits of this field are the length of the frame check sequence.
    link_type = struct.unpack_from(f"{order}I", data, 20)[0] & 0xFFFF
    check_link_type(link_type, where=where)
    integers = Integers(data, order)
    form = layout(order, _RECORD_HEADER_BYTES, seconds=(0, 4), ticks=(4, 4), captured=(8, 4), wire=(12, 4))
    at, count, damage = _FILE_HEADER_BYTES, 0, None
    while True:
        starts, at = _scan(data, order, at, min(at + chunk_bytes, size - _RECORD_HEADER_BYTES + 1))
        frames, valid = _frames(integers, form, starts, link_type, ticks_per_s)
        if not valid.all():
            frames = frames.where(slice(0, int(valid.argmin())))
            damage = f"no packet header at byte {starts[len(frames)]}, after packet {count + len(frames)}"
        elif at > size:
            frames = frames.where(slice(0, len(frames) - 1))
            damage = f"ends inside the packet at byte {starts[-1]}, after packet {count + len(frames)}"
        elif size - _RECORD_HEADER_BYTES < at < size:
            damage = f"ends inside the packet at byte {at}, after packet {count + len(frames)}"
        count += len(frames)
        yield Chunk(frames, damage)
        if damage or at == size:
            return


def _scan(data: Buffer, order: Order, at: int, stop: int) -> tuple[Ints, int]:
    """Return the start positions of the records from `at` to before `stop`, and the position of the next record.

    A snap length gives most records the same length. Such records are checked together, in groups of growing size.
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
    """Return the number of consecutive records of `step` bytes from `at` on, at most `count`."""
    captured = np.ndarray(count, f"{order}u4", buffer=data, offset=at + 8, strides=(step,))
    differ = captured != step - _RECORD_HEADER_BYTES
    return int(differ.argmax()) if differ.any() else len(differ)


def _frames(
    integers: Integers, form: np.dtype[np.void], start: Ints, link_type: int, ticks_per_s: int
) -> tuple[Frames, Mask]:
    """Return the frames of the records at the positions `start`, and a mask of valid record headers."""
    head = integers.fields(form, start)
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


CHUNK_BYTES: Final = 1 << 22
"""Number of file bytes that are decoded together; the memory needed besides the columns is a few times as much."""

_SPARE_DIVISOR: Final = 8
"""The expected number of rows divided by this is the number of additional rows that are allocated."""

READERS: Final = dict.fromkeys(CLASSIC_MAGIC, classic_chunks) | {pcapng.MAGIC: pcapng.chunks}
"""Readers of frames, by the first four bytes of the file."""


@dataclass(frozen=True)
class Capture:
    """Packets of a capture file or of a chunk of it.

    Attributes:
        packets: IP packets.
        frames: Number of frames, including those without a decodable IP packet: too short, encrypted, or of an
            unknown link type.
        damage: Position and kind of damage after `packets`, or None if the file is undamaged.
    """

    packets: Packets
    frames: int
    damage: str | None


def read(path: Path) -> Capture:
    """Return the packets of a capture file.

    Raises:
        EvidenceError: The file is missing, not pcap or pcapng, or has an unknown link type.
    """
    return _concatenate(stream(path), reading.size(path))


def parse(data: bytes, *, where: str) -> Capture:
    """Return the packets in the bytes of a capture file; `where` is its name for messages.

    Raises:
        EvidenceError: The bytes are not pcap or pcapng, or have an unknown link type.
    """
    return _concatenate(_captures(data, where, CHUNK_BYTES), len(data))


def stream(path: Path, *, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Capture]:
    """Yield the packets of a capture file in chunks, at least one, for files whose columns do not fit into memory.

    Only the last chunk can have damage. A large file must not be truncated while it is read, see `reading.mapped`.

    Args:
        path: The file.
        chunk_bytes: Size of a chunk in the file, in bytes; the packet that crosses the boundary is the chunk's last.

    Raises:
        EvidenceError: As for `read`. An unknown link type in a later section is only found after earlier chunks.
    """
    data = reading.mapped(path)
    for capture in _captures(data, str(path), chunk_bytes):
        yield capture
        if isinstance(data, mmap):
            # Pages of the mapping count as this process's memory until they are released.
            data.madvise(MADV_DONTNEED)


def _captures(data: Buffer, where: str, chunk_bytes: int) -> Iterator[Capture]:
    magic = bytes(data[:4])
    if magic not in READERS:
        raise EvidenceError(
            "is not a pcap or pcapng file" if data else "is empty",
            where=where,
            remedy="read the capture's log: tcpdump must have started, and must be stopped with SIGINT or SIGTERM",
        )
    integers = Integers(data)
    for chunk in READERS[magic](data, where=where, chunk_bytes=chunk_bytes):
        yield Capture(decode(integers, chunk.frames), len(chunk.frames), chunk.damage)


def _concatenate(captures: Iterable[Capture], size_bytes: int) -> Capture:
    """Return all packets of a file. Each chunk is freed after it was copied, so little additional memory is needed.

    The number of rows is estimated from the packets so far, with a margin. Rows that are never written occupy no
    physical memory.
    """
    chunks = -(-size_bytes // CHUNK_BYTES)
    joined: Packets | None = None
    rows, frames, damage = 0, 0, None
    for capture in captures:
        stop = rows + len(capture.packets)
        if joined is None or stop > len(joined):
            larger = capture.packets.allocate(
                stop + max(stop * (chunks - 1), rows) * (_SPARE_DIVISOR + 1) // _SPARE_DIVISOR
            )
            if joined is not None:
                larger.write(0, joined.where(slice(0, rows)))
            joined = larger
        joined.write(rows, capture.packets)
        rows, frames, damage = stop, frames + capture.frames, capture.damage
    if joined is None:
        raise ValueError("a capture file has at least one chunk")
    return Capture(joined.where(slice(0, rows)), frames, damage)
