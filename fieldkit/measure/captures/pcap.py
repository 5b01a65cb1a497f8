"""Capture files, pcap and pcapng: their IP packets as columns, whole or chunk by chunk."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from mmap import MADV_DONTNEED, mmap
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import classic, pcapng
from fieldkit.measure.captures.arrays import Buffer, Integers
from fieldkit.measure.captures.packets import Packets, decode
from fieldkit.measure.evidence import reading

CHUNK_BYTES: Final = 1 << 22
"""How much of a file is decoded at once: some MB more than the columns are then all the memory that it takes."""

_SPARE: Final = 8
"""Beside the rows that are expected there is room for one more in so many."""

READERS: Final = dict.fromkeys(classic.MAGIC, classic.chunks) | {pcapng.MAGIC: pcapng.chunks}
"""Readers of a file's frames, by the first four bytes of the file."""


@dataclass(frozen=True)
class Capture:
    """Packets of a capture file, or of a chunk of it.

    Attributes:
        packets: Its IP packets.
        frames: Number of frames, also those that show no IP packet: too short, encrypted, of an unknown link type.
        damage: Where and how the file is damaged, None when it is whole; `packets` are those before.
    """

    packets: Packets
    frames: int
    damage: str | None


def read(path: Path) -> Capture:
    """Return the packets of a capture file.

    Raises:
        EvidenceError: The file is missing, no pcap or pcapng, or of an unknown link type.
    """
    return _joined(stream(path), reading.size(path))


def parse(data: bytes, *, where: str) -> Capture:
    """Return the packets of a capture file's bytes; `where` names it in messages.

    Raises:
        EvidenceError: Neither pcap nor pcapng, or of an unknown link type.
    """
    return _joined(_captures(data, where, CHUNK_BYTES), len(data))


def stream(path: Path, *, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Capture]:
    """Yield the packets of a capture file in chunks, at least one, for files whose columns do not fit into memory.

    Only the last chunk can tell of damage. A large file must not shrink meanwhile, see `reading.mapped`.

    Args:
        path: The file.
        chunk_bytes: How much of it goes into a chunk, in bytes; the packet that reaches beyond is the last.

    Raises:
        EvidenceError: As `read`, for an unknown link type of a later section in the midst of the chunks.
    """
    data = reading.mapped(path)
    for capture in _captures(data, str(path), chunk_bytes):
        yield capture
        if isinstance(data, mmap):
            # Pages once read count as this process's memory until they are given back.
            data.madvise(MADV_DONTNEED)


def _captures(data: Buffer, where: str, chunk_bytes: int) -> Iterator[Capture]:
    magic = bytes(data[:4])
    if magic not in READERS:
        raise EvidenceError(
            "is no pcap or pcapng file" if data else "is empty",
            where=where,
            remedy="read the capture's log: did tcpdump start, and was it ended by a signal that it can catch?",
        )
    integers = Integers(data)
    for chunk in READERS[magic](data, where=where, chunk_bytes=chunk_bytes):
        yield Capture(decode(integers, chunk.frames), len(chunk.frames), chunk.damage)


def _joined(captures: Iterable[Capture], size_bytes: int) -> Capture:
    """Return all of a file's packets, in hardly more memory than they take: what is joined is let go of at once.

    There is room for as many as there will be if the file goes on as it begins, and some more: rows that are never
    written take no memory.
    """
    chunks = -(-size_bytes // CHUNK_BYTES)
    joined: Packets | None = None
    rows, frames, damage = 0, 0, None
    for capture in captures:
        stop = rows + len(capture.packets)
        if joined is None or stop > len(joined):
            longer = capture.packets.room(stop + max(stop * (chunks - 1), rows) * (_SPARE + 1) // _SPARE)
            if joined is not None:
                longer.write(0, joined.where(slice(0, rows)))
            joined = longer
        joined.write(rows, capture.packets)
        rows, frames, damage = stop, frames + capture.frames, capture.damage
    if joined is None:
        raise ValueError("a capture file has one chunk at least")
    return Capture(joined.where(slice(0, rows)), frames, damage)
