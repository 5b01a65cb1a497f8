"""Find bytes in the packets of a capture: where each occurrence is, and what follows it."""

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
        packet: Index of the packet, as `pcap.read` counts them.
        offset: Position of the pattern behind the IP header of its packet, in bytes.
        first: The little-endian integer of 8 bytes behind the pattern.
        second: The next one.
    """

    packet: Ints
    offset: Ints
    first: Ints
    second: Ints


def find(path: Path, pattern: bytes) -> Occurrences:
    """Return each occurrence of a pattern that a capture kept with the two integers behind it.

    An occurrence that begins in a later IP fragment, or that the snap length cut, is not found.

    Raises:
        EvidenceError: As `pcap.read`.
    """
    data = reading.mapped(path)
    integers = Integers(data)
    reader = READERS.get(bytes(data[:4]))
    parts, packets = [_none()], 0
    for chunk in reader(data, where=str(path), chunk_bytes=CHUNK_BYTES) if reader else ():
        ip = headers(integers, chunk.frames, network(integers, chunk.frames))
        frames = chunk.frames.where(ip.frame)
        found = _positions(data, frames, pattern)
        row = np.searchsorted(frames.start, found, side="right") - 1
        ends = frames.start[row] + frames.captured_bytes[row]
        inside = (found >= ip.payload_at[row]) & (found + len(pattern) + 2 * _WORD_BYTES <= ends)
        inside &= ip.fragment_offset[row] == 0
        found, row = found[inside], row[inside]
        little, after = integers.in_order(LITTLE), found + len(pattern)
        numbers = (little.u64(after + at).astype(np.int64) for at in (0, _WORD_BYTES))
        parts.append(Occurrences(packets + row, found - ip.payload_at[row], *numbers))
        packets += len(frames)
    return Occurrences.joined(parts)


def _none() -> Occurrences:
    return Occurrences(*(np.empty(0, dtype=np.int64) for _ in range(4)))


def _positions(data: Buffer, frames: Frames, pattern: bytes) -> Ints:
    """Return where the pattern begins in the file, between the first frame and the end of the last."""
    positions: list[int] = []
    if len(frames):
        at, end = int(frames.start[0]), int(frames.start[-1] + frames.captured_bytes[-1])
        while (at := data.find(pattern, at, end)) >= 0:
            positions.append(at)
            at += 1
    return np.array(positions, dtype=np.int64)
