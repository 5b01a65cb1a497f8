"""Classic pcap files as numpy columns: record boundaries by a scan, everything else vectorized.

File format: draft-ietf-opsawg-pcap; link types: https://www.tcpdump.org/linktypes.html; headers: RFC 791 (IPv4),
RFC 9293 (TCP), RFC 768 (UDP).
"""

import struct
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.errors import EvidenceError
from fieldkit.measure import evidence

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

TCP: Final = 6
UDP: Final = 17
SCTP: Final = 132

SYN: Final = 0x02

NO_PORT: Final = -1
"""Port of a packet that carries none: a later fragment, or another protocol."""

_FILE_HEADER_BYTES: Final = 24
_RECORD_HEADER_BYTES: Final = 16
_IPV4_HEADER_BYTES: Final = 20
# Byte order and clock ticks per second, by the first four bytes of the file.
_MAGIC: Final = {
    b"\xd4\xc3\xb2\xa1": ("<", 1_000_000),
    b"\xa1\xb2\xc3\xd4": (">", 1_000_000),
    b"\x4d\x3c\xb2\xa1": ("<", 1_000_000_000),
    b"\xa1\xb2\x3c\x4d": (">", 1_000_000_000),
}
# libpcap's MAXIMUM_SNAPLEN: no record of a sound file is longer.
_MAX_CAPTURED_BYTES: Final = 262_144
# The longest link header here, the longest IPv4 header, the part of a TCP header that is read.
_MAX_HEADERS_BYTES: Final = 20 + 60 + 20
_ETHERTYPE_IPV4: Final = 0x0800


@dataclass(frozen=True)
class _Link:
    header_bytes: int
    ethertype_at: int | None


_LINKS: Final = {
    1: _Link(header_bytes=14, ethertype_at=12),  # Ethernet
    12: _Link(header_bytes=0, ethertype_at=None),  # raw IP, as DLT_RAW
    101: _Link(header_bytes=0, ethertype_at=None),  # raw IP
    113: _Link(header_bytes=16, ethertype_at=14),  # Linux cooked
    276: _Link(header_bytes=20, ethertype_at=0),  # Linux cooked, version 2
}


@dataclass(frozen=True, eq=False)
class Packets:
    """IPv4 packets in the order of the capture, one numpy column per field.

    Attributes:
        time_ns: Time of capture, nanoseconds since 1970 UTC.
        wire_bytes: Length of the whole frame on the link, not only of what was kept.
        src: Source address.
        dst: Destination address.
        protocol: IP protocol number.
        ip_id: Identification; fragments of one datagram share it.
        fragment_offset: Offset of the payload in its datagram, in bytes; 0 unless a later fragment.
        more_fragments: Whether fragments follow.
        ip_payload_bytes: Bytes after the IP header, by the IP header (not by what was kept).
        sport: Source port of TCP, UDP and SCTP; `NO_PORT` where the packet carries none.
        dport: Destination port, likewise.
        tcp_seq: TCP sequence number; 0 without a TCP header.
        tcp_flags: TCP flags; 0 without a TCP header.
        tcp_payload_bytes: Bytes after the TCP header; 0 without one.
        udp_bytes: Length in the UDP header, itself included; 0 without one.
    """

    time_ns: Ints
    wire_bytes: Ints
    src: NDArray[np.uint32]
    dst: NDArray[np.uint32]
    protocol: Ints
    ip_id: Ints
    fragment_offset: Ints
    more_fragments: Mask
    ip_payload_bytes: Ints
    sport: Ints
    dport: Ints
    tcp_seq: Ints
    tcp_flags: Ints
    tcp_payload_bytes: Ints
    udp_bytes: Ints

    def __len__(self) -> int:
        return len(self.time_ns)

    def where(self, chosen: Mask | Ints) -> "Packets":
        """Return the packets of a mask, or those of an index in its order."""
        return Packets(**{column.name: getattr(self, column.name)[chosen] for column in fields(self)})


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
    if link_type not in _LINKS:
        raise EvidenceError(
            f"has the link type {link_type}, which fieldkit cannot read",
            where=where,
            remedy=f"capture on an interface of link type {', '.join(map(str, _LINKS))}",
        )
    starts, damage = _scan(data, order, ticks_per_s)
    packets = _columns(data, starts, order=order, ticks_per_s=ticks_per_s, link=_LINKS[link_type])
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


class _Fields:
    """Big-endian fields at one position per packet."""

    def __init__(self, data: bytes) -> None:
        # The headers of a packet cut short may reach beyond the end of the file; there they read as zero, and what
        # was not kept is masked later.
        self._bytes = np.frombuffer(data + bytes(_MAX_HEADERS_BYTES), dtype=np.uint8)

    def u8(self, at: Ints) -> Ints:
        return self._bytes[at].astype(np.int64)

    def u16(self, at: Ints) -> Ints:
        return self.u8(at) << 8 | self.u8(at + 1)

    def u32(self, at: Ints) -> Ints:
        return self.u16(at) << 16 | self.u16(at + 2)

    def records(self, starts: Ints, order: str) -> Ints:
        raw = self._bytes[starts[:, None] + np.arange(_RECORD_HEADER_BYTES)]
        words: Ints = raw.view(f"{order}u4").astype(np.int64)
        return words


def _columns(data: bytes, starts: list[int], *, order: str, ticks_per_s: int, link: _Link) -> Packets:
    field = _Fields(data)
    start = np.array(starts, dtype=np.int64)
    seconds, ticks, captured, wire = field.records(start, order).T

    frame = start + _RECORD_HEADER_BYTES
    ip = frame + link.header_bytes
    header_bytes = (field.u8(ip) & 0xF) * 4
    # Segmentation offload leaves the total length 0 in frames above 64 KiB: the wire length then tells it.
    total = field.u16(ip + 2)
    total = np.where(total == 0, wire - link.header_bytes, total)
    usable = (field.u8(ip) >> 4 == 4) & (captured >= link.header_bytes + np.maximum(header_bytes, _IPV4_HEADER_BYTES))
    usable &= (header_bytes >= _IPV4_HEADER_BYTES) & (total >= header_bytes)
    if link.ethertype_at is not None:
        usable &= field.u16(frame + link.ethertype_at) == _ETHERTYPE_IPV4

    start, frame, ip, header_bytes, total = (column[usable] for column in (start, frame, ip, header_bytes, total))
    seconds, ticks, captured, wire = (column[usable] for column in (seconds, ticks, captured, wire))
    protocol = field.u8(ip + 9)
    fragment = field.u16(ip + 6)
    offset = (fragment & 0x1FFF) * 8
    payload = total - header_bytes
    transport = ip + header_bytes
    kept = frame + captured - transport

    first = offset == 0
    ports = first & np.isin(protocol, (TCP, UDP, SCTP)) & (kept >= 4)
    tcp = first & (protocol == TCP) & (kept >= 20)
    udp = first & (protocol == UDP) & (kept >= 8)
    tcp_payload = np.maximum(payload - (field.u8(transport + 12) >> 4) * 4, 0)
    return Packets(
        time_ns=seconds * 1_000_000_000 + ticks * (1_000_000_000 // ticks_per_s),
        wire_bytes=wire,
        src=field.u32(ip + 12).astype(np.uint32),
        dst=field.u32(ip + 16).astype(np.uint32),
        protocol=protocol,
        ip_id=field.u16(ip + 4),
        fragment_offset=offset,
        more_fragments=fragment & 0x2000 != 0,
        ip_payload_bytes=payload,
        sport=np.where(ports, field.u16(transport), NO_PORT),
        dport=np.where(ports, field.u16(transport + 2), NO_PORT),
        tcp_seq=np.where(tcp, field.u32(transport + 4), 0),
        tcp_flags=np.where(tcp, field.u8(transport + 13), 0),
        tcp_payload_bytes=np.where(tcp, tcp_payload, 0),
        udp_bytes=np.where(udp, field.u16(transport + 4), 0),
    )
