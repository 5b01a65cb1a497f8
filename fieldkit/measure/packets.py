"""IPv4 packets as numpy columns: every field of all packets at once, from where each frame starts.

Headers: RFC 791 (IPv4), RFC 9293 (TCP), RFC 768 (UDP).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

TCP: Final = 6
UDP: Final = 17
SCTP: Final = 132

SYN: Final = 0x02

NO_PORT: Final = -1
"""Port of a packet that carries none: a later fragment, or another protocol."""

_IPV4_HEADER_BYTES: Final = 20
# The longest link header here, the longest IPv4 header, the part of a TCP header that is read.
_MAX_HEADERS_BYTES: Final = 20 + 60 + 20
_ETHERTYPE_IPV4: Final = 0x0800


@dataclass(frozen=True)
class Link:
    """How a link type frames IP packets.

    Attributes:
        header_bytes: Length of its header.
        ethertype_at: Where in it the EtherType stands; None where every frame is an IP packet.
    """

    header_bytes: int
    ethertype_at: int | None


LINKS: Final[Mapping[int, Link]] = MappingProxyType(
    {
        1: Link(header_bytes=14, ethertype_at=12),  # Ethernet
        12: Link(header_bytes=0, ethertype_at=None),  # raw IP, as DLT_RAW
        101: Link(header_bytes=0, ethertype_at=None),  # raw IP
        113: Link(header_bytes=16, ethertype_at=14),  # Linux cooked
        276: Link(header_bytes=20, ethertype_at=0),  # Linux cooked, version 2
    }
)
"""By number, as capture files give it (https://www.tcpdump.org/linktypes.html)."""


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


@dataclass(frozen=True, eq=False)
class Frames:
    """Where the frames of a capture stand in its file.

    Attributes:
        start: Index of the first byte of each.
        captured_bytes: How much of it was kept.
        wire_bytes: Its length on the link.
        time_ns: Time of capture, nanoseconds since 1970 UTC.
    """

    start: Ints
    captured_bytes: Ints
    wire_bytes: Ints
    time_ns: Ints


def decode(data: bytes, frames: Frames, link: Link) -> Packets:
    """Return the IPv4 packets among `frames`; others, and ones cut within the IP header, are left out."""
    field = _Fields(data)
    start, captured, wire, time_ns = frames.start, frames.captured_bytes, frames.wire_bytes, frames.time_ns
    ip = start + link.header_bytes
    header_bytes = (field.u8(ip) & 0xF) * 4
    # Segmentation offload leaves the total length 0 in frames above 64 KiB: the wire length then tells it.
    total = field.u16(ip + 2)
    total = np.where(total == 0, wire - link.header_bytes, total)
    usable = (field.u8(ip) >> 4 == 4) & (captured >= link.header_bytes + np.maximum(header_bytes, _IPV4_HEADER_BYTES))
    usable &= (header_bytes >= _IPV4_HEADER_BYTES) & (total >= header_bytes)
    if link.ethertype_at is not None:
        usable &= field.u16(start + link.ethertype_at) == _ETHERTYPE_IPV4

    start, captured, wire, time_ns = start[usable], captured[usable], wire[usable], time_ns[usable]
    ip, header_bytes, total = ip[usable], header_bytes[usable], total[usable]
    protocol = field.u8(ip + 9)
    fragment = field.u16(ip + 6)
    offset = (fragment & 0x1FFF) * 8
    payload = total - header_bytes
    transport = ip + header_bytes
    # Ethernet pads short frames: what was kept may be more than the packet.
    kept = np.minimum(start + captured - transport, payload)

    first = offset == 0
    ports = first & np.isin(protocol, (TCP, UDP, SCTP)) & (kept >= 4)
    tcp = first & (protocol == TCP) & (kept >= 20)
    udp = first & (protocol == UDP) & (kept >= 8)
    tcp_payload = np.maximum(payload - (field.u8(transport + 12) >> 4) * 4, 0)
    return Packets(
        time_ns=time_ns,
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
