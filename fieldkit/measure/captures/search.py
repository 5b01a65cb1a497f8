"""Search for a byte pattern in the packets of a capture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import LITTLE, Buffer, Frames, Integers, Ints, Table
from fieldkit.measure.captures.ip import headers
from fieldkit.measure.captures.links import network
from fieldkit.measure.captures.pcap import CHUNK_BYTES, READERS
from fieldkit.measure.evidence import reading

_WORD_BYTES: Final = 8


@dataclass(frozen=True, eq=False)
class Occurrences(Table):
    """Occurrences of a pattern in the order of the capture.

    Attributes:
        packet: Index of the packet in the result of `pcap.read`.
        offset: Position of the pattern in the packet's IP payload, in bytes.
        first: Little-endian integer in the 8 bytes after the pattern.
        second: Integer in the next 8 bytes.
    """

    packet: Ints
    offset: Ints
    first: Ints
    second: Ints


def find(path: Path, pattern: bytes) -> Occurrences:
    """Return each captured occurrence of a pattern with the two integers after it.

    Occurrences that start in a later IP fragment, or that the snap length truncated, are not found.

    Raises:
        EvidenceError: As for `pcap.read`.
    """
    data = reading.mapped(path)
    integers = Integers(data)
    reader = READERS.get(bytes(data[:4]))
    parts, packets = [_no_occurrences()], 0
    for chunk in reader(data, where=str(path), chunk_bytes=CHUNK_BYTES) if reader else ():
        ip = headers(integers, chunk.frames, network(integers, chunk.frames))
        frames = chunk.frames.where(ip.frame)
        matches = _positions(data, frames, pattern)
        row = np.searchsorted(frames.start, matches, side="right") - 1
        ends = frames.start[row] + frames.captured_bytes[row]
        inside = (matches >= ip.payload_at[row]) & (matches + len(pattern) + 2 * _WORD_BYTES <= ends)
        inside &= ip.fragment_offset[row] == 0
        matches, row = matches[inside], row[inside]
        little, after = integers.with_order(LITTLE), matches + len(pattern)
        numbers = (little.u64(after + at).astype(np.int64) for at in (0, _WORD_BYTES))
        parts.append(Occurrences(packets + row, matches - ip.payload_at[row], *numbers))
        packets += len(frames)
    return Occurrences.concatenated(parts)


def _no_occurrences() -> Occurrences:
    return Occurrences(*(np.empty(0, dtype=np.int64) for _ in range(4)))


def _positions(data: Buffer, frames: Frames, pattern: bytes) -> Ints:
    """Return the positions of the pattern in the file, between the first frame and the end of the last."""
    positions: list[int] = []
    if len(frames):
        at, end = int(frames.start[0]), int(frames.start[-1] + frames.captured_bytes[-1])
        while (at := data.find(pattern, at, end)) >= 0:
            positions.append(at)
            at += 1
    return np.array(positions, dtype=np.int64)
