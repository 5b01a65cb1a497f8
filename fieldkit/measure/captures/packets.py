"""IP packets as numpy columns: every field of all packets at once, from where each frame starts.

Headers: RFC 9293 (TCP), RFC 7323 (its time stamps), RFC 768 (UDP), RFC 792 (ICMP).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from fieldkit.measure.captures.arrays import BIG, LITTLE, Frames, Integers, Ints, Mask, Narrow, Table, layout, mixed
from fieldkit.measure.captures.ip import ICMP, SCTP, TCP, UDP, Addresses, address, headers
from fieldkit.measure.captures.links import network

FIN: Final = 0x01
SYN: Final = 0x02
RST: Final = 0x04
ACK: Final = 0x10

UDP_HEADER_BYTES: Final = 8

_TRANSPORT: Final = layout(
    BIG, 20, sport=(0, 2), dport=(2, 2), udp_bytes=(4, 2), seq=(4, 4), ack=(8, 4), length=(12, 1), flags=(13, 1)
)

NO_PORT: Final = -1
"""Port of a packet that carries none: a later fragment, or another protocol."""

NO_STAMP: Final = -1
"""TCP time stamp of a packet that carries none, or was cut before it."""

NO_ECHO: Final = -1
"""Identifier of a packet that is no ICMP echo, or was cut before it."""

ECHO_REPLY: Final = 1 << 16
"""Added to the identifier of an echo that is a reply."""

NOT_KEPT: Final = -1
"""Content of a packet that was cut before `CONTENT_BYTES` of it."""

CONTENT_BYTES: Final = 32
"""How much of a packet's content is compared: fieldkit's captures keep more behind any headers, 128 bytes in all."""

_CONTENT: Final = layout(LITTLE, CONTENT_BYTES, **{str(at): (at, 8) for at in range(0, CONTENT_BYTES, 8)})
_FIRST_BYTES: Final = np.array([(1 << 8 * count) - 1 for count in range(9)], dtype=np.uint64).astype(np.int64)
_REPLY: Final = 0
_REQUEST: Final = 8
_MSS_OPTION: Final = 2
_STAMP_OPTION: Final = 8
# Two that do nothing, then the time stamp: how most systems write it, so that it is aligned (RFC 7323, appendix A).
_ALIGNED_STAMP: Final = 0x0101080A


@dataclass(frozen=True, eq=False)
class Packets(Table):
    """IP packets in the order of the capture, one numpy column per field.

    Attributes:
        time_ns: Time of capture, nanoseconds since 1970 UTC; `frames.NO_TIME` where the file tells none.
        wire_bytes: Length of the whole frame on the link, not only of what was kept.
        src: Source address.
        dst: Destination address.
        protocol: IP protocol number, the one after IPv6 extension headers.
        ip_id: Identification; fragments of one datagram share it. 0 in an IPv6 packet that is no fragment.
        fragment_offset: Offset of the payload in its datagram, in bytes; 0 unless a later fragment.
        more_fragments: Whether fragments follow.
        ip_header_bytes: Bytes of the IP header and its extensions.
        ip_payload_bytes: Bytes after the IP header and its extensions, by the header (not by what was kept).
        sport: Source port of TCP, UDP and SCTP; `NO_PORT` where the packet carries none.
        dport: Destination port, likewise.
        tcp_seq: TCP sequence number; 0 without a TCP header.
        tcp_ack: TCP acknowledgment number; 0 without a TCP header.
        tcp_flags: TCP flags; 0 without a TCP header.
        tcp_stamp: Value of TCP's time stamp (TSval, which a retransmission has later); `NO_STAMP` without one.
        tcp_mss: Largest segment that a SYN announces as its sender's limit; 0 in all others, and where it tells none.
        tcp_payload_bytes: Bytes after the TCP header; 0 without one.
        udp_bytes: Length in the UDP header, itself included; 0 without one.
        echo: Identifier of an ICMP echo request, which each ping has for itself, and of a reply, plus `ECHO_REPLY`;
            `NO_ECHO` without one.
        echo_seq: Sequence number of an ICMP echo request or reply; `NO_ECHO` without one.
        content: A number for the first `CONTENT_BYTES` behind the TCP or UDP header, else behind the IP header (so
            that a checksum, which offload leaves for later, is not in it): other numbers are other bytes. `NOT_KEPT`
            where so many are not there to be read.
    """

    time_ns: Ints
    wire_bytes: Ints
    src: Addresses
    dst: Addresses
    protocol: Ints
    ip_id: Ints
    fragment_offset: Ints
    more_fragments: Mask
    ip_header_bytes: Ints
    ip_payload_bytes: Ints
    sport: Ints
    dport: Ints
    tcp_seq: Ints
    tcp_ack: Ints
    tcp_flags: Ints
    tcp_stamp: Ints
    tcp_mss: Ints
    tcp_payload_bytes: Ints
    udp_bytes: Ints
    echo: Ints
    echo_seq: Ints
    content: Ints

    def are_from(self, text: str) -> Mask:
        """Return which packets have this IPv4 or IPv6 source address."""
        return _equals(self.src, text)

    def are_to(self, text: str) -> Mask:
        """Return which packets have this IPv4 or IPv6 destination address."""
        return _equals(self.dst, text)


_KEPT_AS: Final[Mapping[str, type[np.integer[Any]]]] = MappingProxyType(
    {
        **dict.fromkeys(("protocol", "tcp_flags"), np.uint8),
        **dict.fromkeys(("fragment_offset", "tcp_mss", "udp_bytes"), np.uint16),
        **dict.fromkeys(("wire_bytes", "ip_id", "ip_header_bytes", "ip_payload_bytes"), np.uint32),
        **dict.fromkeys(("tcp_seq", "tcp_ack", "tcp_payload_bytes"), np.uint32),
        **dict.fromkeys(("sport", "dport", "echo", "echo_seq"), np.int32),
    }
)
"""Columns that need fewer than eight bytes: what their header fields hold, and the marks below 0."""

for _name, _kind in _KEPT_AS.items():
    _column = Narrow(_kind)
    _column.__set_name__(Packets, _name)
    setattr(Packets, _name, _column)


def decode(integers: Integers, frames: Frames) -> Packets:
    """Return the IP packets among `frames`; others, and ones cut within the IP header, are left out."""
    ip = headers(integers, frames, network(integers, frames))
    if len(ip) < len(frames):
        frames = frames.where(ip.frame)
    transport, payload, protocol = ip.payload_at, ip.payload_bytes, ip.protocol
    # Ethernet pads short frames: what was kept may be more than the packet.
    kept = np.minimum(frames.start + frames.captured_bytes - transport, payload)

    first = ip.fragment_offset == 0
    is_tcp, is_udp = first & (protocol == TCP), first & (protocol == UDP)
    ports = (is_tcp | is_udp | first & (protocol == SCTP)) & (kept >= 4)
    tcp, udp = is_tcp & (kept >= 20), is_udp & (kept >= UDP_HEADER_BYTES)
    head = integers.fields(_TRANSPORT, transport)
    tcp_header = (head["length"] >> 4) * 4
    tcp_flags = np.where(tcp, head["flags"], 0)
    options_end = transport + np.minimum(kept, tcp_header)
    echo = _echoes(integers, first & (protocol == ICMP) & (kept >= 8), transport)
    skipped = np.where(tcp, tcp_header, np.where(udp, UDP_HEADER_BYTES, 0))
    return Packets(
        time_ns=frames.time_ns,
        wire_bytes=frames.wire_bytes,
        src=ip.src,
        dst=ip.dst,
        protocol=protocol,
        ip_id=ip.ip_id,
        fragment_offset=ip.fragment_offset,
        more_fragments=ip.more_fragments,
        ip_header_bytes=ip.header_bytes,
        ip_payload_bytes=payload,
        sport=np.where(ports, head["sport"], NO_PORT),
        dport=np.where(ports, head["dport"], NO_PORT),
        tcp_seq=np.where(tcp, head["seq"], 0),
        tcp_ack=np.where(tcp, head["ack"], 0),
        tcp_flags=tcp_flags,
        tcp_stamp=_stamps(integers, tcp, transport, options_end),
        tcp_mss=_option(integers, np.flatnonzero(tcp_flags & SYN), transport, options_end, _MSS_OPTION, missing=0),
        tcp_payload_bytes=np.where(tcp, np.maximum(payload - tcp_header, 0), 0),
        udp_bytes=np.where(udp, head["udp_bytes"], 0),
        echo=echo,
        echo_seq=np.where(echo == NO_ECHO, NO_ECHO, integers.u16(np.where(echo == NO_ECHO, 0, transport + 6))),
        content=_contents(integers, transport + skipped, kept - skipped, payload - skipped),
    )


def _stamps(integers: Integers, tcp: Mask, transport: Ints, end: Ints) -> Ints:
    """Return TSval of the packets `tcp`, of which headers start at `transport` and options end at `end`."""
    found = np.full_like(transport, NO_STAMP)
    if not tcp.any():
        return found
    aligned = tcp & (transport + 32 <= end)
    aligned[aligned] = integers.u32(transport[aligned] + 20) == _ALIGNED_STAMP
    found[aligned] = integers.u32(transport[aligned] + 24)
    others = np.flatnonzero(tcp & ~aligned & (transport + 30 <= end))
    return np.where(aligned, found, _option(integers, others, transport, end, _STAMP_OPTION, missing=NO_STAMP))


def _option(integers: Integers, chosen: Ints, transport: Ints, end: Ints, wanted: int, *, missing: int) -> Ints:
    """Return what a TCP option says (RFC 9293, section 3.2; RFC 7323, section 3.2), `missing` where it is not there.

    Args:
        integers: The file.
        chosen: Index of the packets to look into.
        transport: Where the header of each packet starts.
        end: Where what was kept of its options ends.
        wanted: `_MSS_OPTION` or `_STAMP_OPTION`.
        missing: What to return for all other packets.
    """
    found = np.full_like(transport, missing)
    size, read = (4, integers.u16) if wanted == _MSS_OPTION else (10, integers.u32)
    at, end = transport[chosen] + 20, end[chosen]
    going_on = at + size <= end
    while going_on.any():
        chosen, at, end = chosen[going_on], at[going_on], end[going_on]
        kind = integers.u8(at)
        step = np.where(kind == 1, 1, integers.u8(at + 1))
        told = (kind == wanted) & (step == size)
        found[chosen[told]] = read(at[told] + 2)
        at = at + step
        going_on = ~told & (kind != 0) & (step > 0) & (at + size <= end)
    return found


def _echoes(integers: Integers, icmp: Mask, transport: Ints) -> Ints:
    """Return the identifiers of echoes among the packets `icmp`, of which headers start at `transport`."""
    found = np.full_like(transport, NO_ECHO)
    at = transport[icmp]
    kind, identifier = integers.u8(at), integers.u16(at + 4)
    found[icmp] = np.select([kind == _REQUEST, kind == _REPLY], [identifier, identifier + ECHO_REPLY], NO_ECHO)
    return found


def _contents(integers: Integers, at: Ints, kept: Ints, content_bytes: Ints) -> Ints:
    """Return a number for the content of packets that starts at `at`."""
    words = integers.fields(_CONTENT, at)
    wanted = np.clip(content_bytes, 0, CONTENT_BYTES)
    short = np.flatnonzero(wanted < CONTENT_BYTES)
    columns = [words[str(start)] for start in range(0, CONTENT_BYTES, 8)]
    for number, word in enumerate(columns):
        # What follows a short packet in the file is none of it: of eight bytes the first are the lowest.
        word[short] &= _FIRST_BYTES[np.clip(wanted[short] - 8 * number, 0, 8)]
    found = (mixed(*columns) >> np.uint64(1)).astype(np.int64)
    found[kept < wanted] = NOT_KEPT
    return found


def _equals(column: Addresses, text: str) -> Mask:
    upper, lower = address(text)
    equal: Mask = (column[:, 0] == upper) & (column[:, 1] == lower)
    return equal
