"""Capture files, pcap and pcapng: their IP packets as columns, whole or chunk by chunk."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from mmap import MADV_DONTNEED, mmap
from pathlib import Path
from typing import Any, Final

from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures import classic, pcapng
from fieldkit.measure.captures.arrays import Buffer, Integers
from fieldkit.measure.captures.packets import Packets, decode
from fieldkit.measure.evidence import reading

CHUNK_BYTES: Final = 1 << 22
"""How much of a file is decoded at once: some MB more than the columns are then all the memory that it takes."""

_COLUMNS: Final = tuple(column.name for column in fields(Packets))
_SPARE: Final = 8
"""Of the rows of columns that grow, one in so many is room for more."""

_READERS: Final = dict.fromkeys(classic.MAGIC, classic.chunks) | {pcapng.MAGIC: pcapng.chunks}


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
    return _joined(stream(path))


def parse(data: bytes, *, where: str) -> Capture:
    """Return the packets of a capture file's bytes; `where` names it in messages.

    Raises:
        EvidenceError: Neither pcap nor pcapng, or of an unknown link type.
    """
    return _joined(_captures(data, where, CHUNK_BYTES))


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
    if magic not in _READERS:
        raise EvidenceError(
            "is no pcap or pcapng file" if data else "is empty",
            where=where,
            remedy="read the capture's log: did tcpdump start, and was it ended by a signal that it can catch?",
        )
    integers = Integers(data)
    for chunk in _READERS[magic](data, where=where, chunk_bytes=chunk_bytes):
        yield Capture(decode(integers, chunk.frames), len(chunk.frames), chunk.damage)


def _joined(captures: Iterable[Capture]) -> Capture:
    """Return all of a file's packets, in hardly more memory than they take: what is joined is let go of at once."""
    columns: dict[str, NDArray[Any]] = {}
    rows, room, frames, damage = 0, 0, 0, None
    for one in captures:
        parts = {name: getattr(one.packets, name) for name in _COLUMNS}
        columns = columns or {name: part[:0].copy() for name, part in parts.items()}
        stop = rows + len(one.packets)
        if stop > room:
            room = max(stop, room + room // _SPARE) if rows else stop
            _resize(columns, room)
        for name, part in parts.items():
            columns[name][rows:stop] = part
        rows, frames, damage = stop, frames + one.frames, one.damage
    _resize(columns, rows)
    return Capture(Packets(**columns), frames, damage)


def _resize(columns: Mapping[str, NDArray[Any]], rows: int) -> None:
    """Give columns so many rows, in their place: the system moves the pages of a large one and copies none."""
    for column in columns.values():
        column.resize((rows, *column.shape[1:]), refcheck=False)
