"""Classic pcap files: record boundaries by a scan; the packets in them are decoded all at once.

File format: draft-ietf-opsawg-pcap.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.errors import EvidenceError
from fieldkit.measure import evidence
from fieldkit.measure.packets import LINKS, Frames, Packets, decode

_FILE_HEADER_BYTES: Final = 24
_RECORD_HEADER_BYTES: Final = 16
# Byte order and clock ticks per second, by the first four bytes of the file.
_MAGIC: Final = {
    b"\xd4\xc3\xb2\xa1": ("<", 1_000_000),
    b"\xa1\xb2\xc3\xd4": (">", 1_000_000),
    b"\x4d\x3c\xb2\xa1": ("<", 1_000_000_000),
    b"\xa1\xb2\x3c\x4d": (">", 1_000_000_000),
}
# libpcap's MAXIMUM_SNAPLEN: no record of a sound file is longer.
_MAX_CAPTURED_BYTES: Final = 262_144


@dataclass(frozen=True)
class Capture:
    """What a capture file holds.

    Attributes:
        packets: Its IPv4 packets.
        frames: Number of frames, IPv4 or not.
        damage: Where and how the file is damaged, None when it is whole; `packets` are those before.
    """

    packets: Packets
    frames: int
    damage: str | None

    @property
    def other_frames(self) -> int:
        """Frames that are no IPv4 packet, or too short to tell."""
        return self.frames - len(self.packets)


def read(path: Path) -> Capture:
    """Return the packets of a capture file.

    Raises:
        EvidenceError: The file is missing, no classic pcap, or of an unknown link type.
    """
    return parse(evidence.content(path), where=str(path))


def parse(data: bytes, *, where: str) -> Capture:
    """Return the packets of a capture file's bytes; `where` names it in messages.

    Raises:
        EvidenceError: Not a classic pcap, or of an unknown link type.
    """
    if len(data) < _FILE_HEADER_BYTES or data[:4] not in _MAGIC:
        raise EvidenceError(
            "is empty" if not data else "is not a classic pcap file",
            where=where,
            remedy="read the capture's log: did tcpdump start, and was it ended by a signal that it can catch?",
        )
    order, ticks_per_s = _MAGIC[data[:4]]
    # The upper bits of the field say how long the frame check sequence is.
    link_type = struct.unpack_from(f"{order}I", data, 20)[0] & 0xFFFF
    if link_type not in LINKS:
        raise EvidenceError(
            f"has the link type {link_type}, which fieldkit cannot read",
            where=where,
            remedy=f"capture on an interface of link type {', '.join(map(str, LINKS))}",
        )
    starts, damage = _scan(data, order, ticks_per_s)
    packets = decode(data, _frames(data, starts, order, ticks_per_s), LINKS[link_type])
    return Capture(packets=packets, frames=len(starts), damage=damage)


def _scan(data: bytes, order: str, ticks_per_s: int) -> tuple[list[int], str | None]:
    """Return where each whole record starts, and the damage that ended the scan."""
    header = struct.Struct(f"{order}4I").unpack_from
    starts: list[int] = []
    at, size = _FILE_HEADER_BYTES, len(data)
    while at + _RECORD_HEADER_BYTES <= size:
        _, ticks, captured, wire = header(data, at)
        if ticks >= ticks_per_s or captured > wire or captured > _MAX_CAPTURED_BYTES:
            return starts, f"no packet header at byte {at}, after packet {len(starts)}"
        end = at + _RECORD_HEADER_BYTES + captured
        if end > size:
            break
        starts.append(at)
        at = end
    if at == size:
        return starts, None
    return starts, f"ends inside the packet at byte {at}, after packet {len(starts)}"


def _frames(data: bytes, starts: list[int], order: str, ticks_per_s: int) -> Frames:
    """Return the frames of the records that start at `starts`."""
    start = np.array(starts, dtype=np.int64)
    raw = np.frombuffer(data, dtype=np.uint8)[start[:, None] + np.arange(_RECORD_HEADER_BYTES)]
    seconds, ticks, captured, wire = raw.view(f"{order}u4").astype(np.int64).T
    return Frames(
        start=start + _RECORD_HEADER_BYTES,
        captured_bytes=captured,
        wire_bytes=wire,
        time_ns=seconds * 1_000_000_000 + ticks * (1_000_000_000 // ticks_per_s),
    )
