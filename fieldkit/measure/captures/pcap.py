"""Readers of capture files in pcap and pcapng format: IP packets as columns, for the whole file or in chunks.

Each format has a module with a function `chunks`. The module is imported when a file of its format is read.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from mmap import MADV_DONTNEED, mmap
from pathlib import Path
from types import MappingProxyType
from typing import Final, Protocol

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Buffer, Chunk, Integers
from fieldkit.measure.captures.packets import Packets, decode
from fieldkit.measure.evidence import reading

CHUNK_BYTES: Final = 1 << 22
"""Number of file bytes that are decoded together. Decoding needs memory for a few times this number of bytes, in
addition to the columns."""

_SPARE_DIVISOR: Final = 8
"""The table has spare rows: the number of rows that is estimated for later chunks, divided by this value."""

FORMATS: Final = MappingProxyType(
    {
        b"\xd4\xc3\xb2\xa1": "classic_pcap",
        b"\xa1\xb2\xc3\xd4": "classic_pcap",
        b"\x4d\x3c\xb2\xa1": "classic_pcap",
        b"\xa1\xb2\x3c\x4d": "classic_pcap",
        b"\x0a\x0d\x0d\x0a": "pcapng",
    }
)
"""Module of this package that reads a format, by the first four bytes of the file."""


class ChunkReader(Protocol):
    """The function `chunks` of a format's module."""

    def __call__(self, data: Buffer, *, where: str, chunk_bytes: int) -> Iterator[Chunk]:
        """Yield the frames of a file in chunks of about `chunk_bytes`; there is at least one chunk."""


def frame_reader(data: Buffer) -> ChunkReader | None:
    """Return the reader for the format of a capture file, or None if the format is unknown."""
    module = FORMATS.get(bytes(data[:4]))
    if module is None:
        return None
    reader: ChunkReader = import_module(f"{__package__}.{module}").chunks
    return reader


@dataclass(frozen=True)
class Capture:
    """Packets of a whole capture file, or of one chunk.

    Attributes:
        packets: IP packets.
        frames: Number of frames, including frames without a decodable IP packet: of another protocol, too short,
            encrypted, or of an unknown link type.
        damage: Position and kind of the damage after `packets`, or None if the file is undamaged.
    """

    packets: Packets
    frames: int
    damage: str | None


def read(path: Path) -> Capture:
    """Return the packets of a capture file.

    Raises:
        EvidenceError: The file is missing, not pcap or pcapng, ends inside its header, or has an unknown link type;
            or a pcapng file has too many sections and interfaces.
    """
    return _concatenate(stream(path), reading.size(path))


def parse(data: bytes, *, where: str) -> Capture:
    """Return the packets in the bytes of a capture file; `where` is its name in messages.

    Raises:
        EvidenceError: For the same reasons as `read`.
    """
    return _concatenate(_captures(data, where, CHUNK_BYTES), len(data))


def stream(path: Path, *, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Capture]:
    """Yield the packets of a capture file in one or more chunks; for files whose columns do not fit into memory.

    Only the last chunk can have damage. A large file must not be truncated while it is read (see `reading.mapped`).

    Args:
        path: The file.
        chunk_bytes: Size of a chunk in the file, in bytes; the packet that crosses the boundary is the chunk's last.

    Raises:
        EvidenceError: For the same reasons as `read`. An unknown link type in a later section is detected only after
            the earlier chunks were yielded.
    """
    data = reading.mapped(path)
    for capture in _captures(data, str(path), chunk_bytes):
        yield capture
        if isinstance(data, mmap):
            # Pages of the mapping count as this process's memory until they are released.
            data.madvise(MADV_DONTNEED)


def _captures(data: Buffer, where: str, chunk_bytes: int) -> Iterator[Capture]:
    """Yield the decoded packets of each chunk of a file. Raises the same errors as `parse`."""
    reader = frame_reader(data)
    if reader is None:
        raise EvidenceError(
            "is not a pcap or pcapng file" if data else "is empty",
            where=where,
            remedy="read the capture's log: tcpdump must have started, and must be stopped with SIGINT or SIGTERM",
        )
    integers = Integers(data)
    for chunk in reader(data, where=where, chunk_bytes=chunk_bytes):
        yield Capture(decode(integers, chunk.frames), len(chunk.frames), chunk.damage)


def _concatenate(captures: Iterable[Capture], size_bytes: int) -> Capture:
    """Return all packets of a file. Each chunk is freed after it was copied, so little additional memory is needed.

    When the table is full, a larger one is allocated, with rows for as many packets as the remaining chunks probably
    have, and a margin. Rows that are never written occupy no physical memory.
    """
    chunks = -(-size_bytes // CHUNK_BYTES)
    all_packets: Packets | None = None
    rows, frames, damage = 0, 0, None
    for capture in captures:
        stop = rows + len(capture.packets)
        if all_packets is None or stop > len(all_packets):
            larger = capture.packets.allocate(
                stop + max(stop * (chunks - 1), rows) * (_SPARE_DIVISOR + 1) // _SPARE_DIVISOR
            )
            if all_packets is not None:
                larger.write(0, all_packets.where(slice(0, rows)))
            all_packets = larger
        all_packets.write(rows, capture.packets)
        rows, frames, damage = stop, frames + capture.frames, capture.damage
    if all_packets is None:
        raise ValueError("a capture file has at least one chunk")
    return Capture(all_packets.where(slice(0, rows)), frames, damage)
