"""IP packets as numpy columns: each field is decoded for all packets together.

Headers: RFC 9293 (TCP), RFC 7323 (its time stamps), RFC 768 (UDP), RFC 792 (ICMP).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from fieldkit.measure.captures.arrays import (
    BIG,
    LITTLE,
    Frames,
    Integers,
    Ints,
    Mask,
    NarrowColumn,
    Table,
    layout,
    row_hashes,
)
from fieldkit.measure.captures.headers import (
    ICMP,
    SCTP,
    TCP,
    UDP,
    Addresses,
    address,
    interfaces,
    ip_header_positions,
    ip_headers,
)

FIN: Final = 0x01
SYN: Final = 0x02
RST: Final = 0x04
ACK: Final = 0x10
"""TCP flags."""

UDP_HEADER_BYTES: Final = 8

# The ports are at the same place in TCP, UDP and SCTP. `udp_bytes` is a field of UDP; the other fields are of TCP.
_TRANSPORT: Final = layout(
    BIG, 20, sport=(0, 2), dport=(2, 2), udp_bytes=(4, 2), seq=(4, 4), ack=(8, 4), length=(12, 1), flags=(13, 1)
)

NO_PORT: Final = -1
"""Port of a packet without ports: a later fragment, or a packet of another protocol."""

NO_STAMP: Final = -1
"""TCP time stamp of a packet that has no time stamp, or was truncated before it."""

NO_ECHO: Final = -1
"""Identifier of a packet that is not an ICMP echo, or was truncated before it."""

ECHO_REPLY: Final = 1 << 16
"""Added to the identifier of an ICMP echo reply, to distinguish it from a request."""

NOT_CAPTURED: Final = -1
"""Content hash of a packet that was truncated before the end of its first `CONTENT_BYTES` of content."""

CONTENT_BYTES: Final = 32
"""Number of content bytes that are compared. fieldkit captures 128 bytes of each packet, so its captures contain
them if all headers together have at most 96 bytes, such as 20 (link layer), 40 (IPv6) and 32 (TCP with time stamps).
"""

_CONTENT: Final = layout(LITTLE, CONTENT_BYTES, **{str(at): (at, 8) for at in range(0, CONTENT_BYTES, 8)})
# Masks of the first 0 to 8 bytes of a little-endian word, by the number of bytes.
_FIRST_BYTES_MASKS: Final = np.array([(1 << 8 * count) - 1 for count in range(9)], dtype=np.uint64).astype(np.int64)
_ICMP_ECHO_REPLY: Final = 0
_ICMP_ECHO_REQUEST: Final = 8
# Kinds of TCP options.
_MSS_OPTION: Final = 2
_STAMP_OPTION: Final = 8
# Two no-operation options before the time stamp: most systems align it this way (RFC 7323, appendix A).
_ALIGNED_STAMP: Final = 0x0101080A


@dataclass(frozen=True, eq=False)
class Packets(Table):
    """IP packets in the order of the capture, one numpy column per field.

    Attributes:
        time_ns: Time of capture, nanoseconds since 1970 UTC, or `arrays.NO_TIME`.
        wire_bytes: Length of the whole frame on the link, even if fewer bytes were captured.
        src: Source address.
        dst: Destination address.
        protocol: IP protocol number after IPv6 extension headers.
        ip_id: Identification, which is equal in all fragments of a datagram; 0 in an IPv6 packet that is not a
            fragment.
        fragment_offset: Offset of the payload in its datagram in bytes; 0 except for later fragments.
        more_fragments: True if more fragments follow.
        ip_header_bytes: Length of the IP header and its extension headers.
        ip_payload_bytes: Length after the IP header and its extension headers according to the header, even if fewer
            bytes were captured.
        wrong_checksum: True if the header checksum of IPv4 is wrong, which shows that the header was altered.
        sport: Source port of TCP, UDP and SCTP, or `NO_PORT`.
        dport: Destination port, or `NO_PORT`.
        tcp_seq: TCP sequence number; 0 without a TCP header.
        tcp_ack: TCP acknowledgment number; 0 without a TCP header.
        tcp_flags: TCP flags; 0 without a TCP header.
        tcp_stamp: TSval of the TCP time stamp option, which is larger in a retransmission unless this is sent within
            one tick of the sender's time stamp clock; `NO_STAMP` if the option is missing or was truncated.
        tcp_mss: Maximum segment size option of a SYN; 0 if the option is missing or was truncated.
        tcp_payload_bytes: Length after the TCP header; 0 without a TCP header.
        udp_bytes: Length field of the UDP header, which includes the header; 0 without a UDP header.
        echo: Identifier of an ICMP echo request, which differs between ping processes; `ECHO_REPLY` is added in a
            reply. `NO_ECHO` for other packets.
        echo_seq: Sequence number of an ICMP echo request or reply; `NO_ECHO` for other packets.
        content: Hash of the first `CONTENT_BYTES` after the TCP or UDP header or, without one, after the IP header;
            fewer if the packet is shorter. The checksum of TCP and UDP is excluded, because with offload it is
            computed after the capture. `NOT_CAPTURED` if one of these bytes was not captured.
        interface: Index of the interface in captures of the link type `headers.COOKED_V2`, which are on all
            interfaces; `headers.NO_INTERFACE` in other captures.
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
    wrong_checksum: Mask
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
    interface: Ints

    def are_from(self, text: str) -> Mask:
        """Return a mask of the packets with this IPv4 or IPv6 source address."""
        return _equals(self.src, text)

    def are_to(self, text: str) -> Mask:
        """Return a mask of the packets with this IPv4 or IPv6 destination address."""
        return _equals(self.dst, text)

    def icmp(self, source: str, destination: str) -> "Packets":
        """Return the ICMP packets from one address to another."""
        return self.where((self.protocol == ICMP) & self.are_from(source) & self.are_to(destination))


_STORAGE_TYPES: Final[Mapping[str, type[np.integer[Any]]]] = MappingProxyType(
    {
        **dict.fromkeys(("protocol", "tcp_flags"), np.uint8),
        **dict.fromkeys(("fragment_offset", "tcp_mss", "udp_bytes"), np.uint16),
        **dict.fromkeys(("wire_bytes", "ip_id", "ip_header_bytes", "ip_payload_bytes"), np.uint32),
        **dict.fromkeys(("tcp_seq", "tcp_ack", "tcp_payload_bytes"), np.uint32),
        **dict.fromkeys(("sport", "dport", "echo", "echo_seq", "interface"), np.int32),
    }
)
"""Columns stored in fewer than eight bytes. Each type can store the header field and the negative special values."""

# The narrow columns are set after `dataclass` has read the fields, because `dataclass` would use them as default
# values.
for _name, _storage_type in _STORAGE_TYPES.items():
    _column = NarrowColumn(_storage_type)
    _column.__set_name__(Packets, _name)
    setattr(Packets, _name, _column)


def decode(integers: Integers, frames: Frames) -> Packets:
    """Return the IP packets of `frames`; frames without a complete and valid IP header are omitted."""
    ip = ip_headers(integers, frames, ip_header_positions(integers, frames))
    if len(ip) < len(frames):
        frames = frames.where(ip.frame)
    transport, payload, protocol = ip.payload_at, ip.payload_bytes, ip.protocol
    # Ethernet pads short frames, so the capture may contain more bytes than the packet.
    captured = np.minimum(frames.start + frames.captured_bytes - transport, payload)

    is_first = ip.fragment_offset == 0
    is_tcp, is_udp = is_first & (protocol == TCP), is_first & (protocol == UDP)
    has_ports = (is_tcp | is_udp | is_first & (protocol == SCTP)) & (captured >= 4)
    tcp, udp = is_tcp & (captured >= 20), is_udp & (captured >= UDP_HEADER_BYTES)
    head = integers.fields(_TRANSPORT, transport)
    tcp_header = (head["length"] >> 4) * 4
    tcp_flags = np.where(tcp, head["flags"], 0)
    options_end = transport + np.minimum(captured, tcp_header)
    echo = _echo_identifiers(integers, is_first & (protocol == ICMP) & (captured >= 8), transport)
    transport_bytes = np.where(tcp, tcp_header, np.where(udp, UDP_HEADER_BYTES, 0))
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
        wrong_checksum=ip.wrong_checksum,
        sport=np.where(has_ports, head["sport"], NO_PORT),
        dport=np.where(has_ports, head["dport"], NO_PORT),
        tcp_seq=np.where(tcp, head["seq"], 0),
        tcp_ack=np.where(tcp, head["ack"], 0),
        tcp_flags=tcp_flags,
        tcp_stamp=_time_stamps(integers, tcp, transport, options_end),
        tcp_mss=_option(integers, np.flatnonzero(tcp_flags & SYN), transport, options_end, _MSS_OPTION, missing=0),
        tcp_payload_bytes=np.where(tcp, np.maximum(payload - tcp_header, 0), 0),
        udp_bytes=np.where(udp, head["udp_bytes"], 0),
        echo=echo,
        echo_seq=np.where(echo == NO_ECHO, NO_ECHO, integers.u16(np.where(echo == NO_ECHO, 0, transport + 6))),
        content=_content_hashes(
            integers, transport + transport_bytes, captured - transport_bytes, payload - transport_bytes
        ),
        interface=interfaces(integers, frames),
    )


def _time_stamps(integers: Integers, tcp: Mask, transport: Ints, end: Ints) -> Ints:
    """Return the TSval of the packets that the mask `tcp` selects; their options end at `end`."""
    stamps = np.full_like(transport, NO_STAMP)
    if not tcp.any():
        return stamps
    is_aligned = tcp & (transport + 32 <= end)
    # Keep only the packets whose options begin with the time stamp.
    is_aligned[is_aligned] = integers.u32(transport[is_aligned] + 20) == _ALIGNED_STAMP
    stamps[is_aligned] = integers.u32(transport[is_aligned] + 24)
    unaligned_rows = np.flatnonzero(tcp & ~is_aligned & (transport + 30 <= end))
    return np.where(
        is_aligned, stamps, _option(integers, unaligned_rows, transport, end, _STAMP_OPTION, missing=NO_STAMP)
    )


def _option(integers: Integers, rows: Ints, transport: Ints, end: Ints, option: int, *, missing: int) -> Ints:
    """Return the value of a TCP option (RFC 9293, section 3.2; RFC 7323, section 3.2), or `missing`.

    Args:
        integers: Reader of integers in the file.
        rows: Indices of the packets to read.
        transport: Position of each packet's TCP header.
        end: Position of the end of each packet's captured options.
        option: `_MSS_OPTION` or `_STAMP_OPTION`.
        missing: Value for packets without the option.
    """
    values = np.full_like(transport, missing)
    size, read = (4, integers.u16) if option == _MSS_OPTION else (10, integers.u32)
    at, end = transport[rows] + 20, end[rows]
    has_more = at + size <= end
    while has_more.any():
        rows, at, end = rows[has_more], at[has_more], end[has_more]
        kind = integers.u8(at)
        # An option of kind 1 (no operation) has no length field, and kind 0 ends the list.
        step = np.where(kind == 1, 1, integers.u8(at + 1))
        matches = (kind == option) & (step == size)
        values[rows[matches]] = read(at[matches] + 2)
        at = at + step
        has_more = ~matches & (kind != 0) & (step > 0) & (at + size <= end)
    return values


def _echo_identifiers(integers: Integers, icmp: Mask, transport: Ints) -> Ints:
    """Return the identifiers of the ICMP echoes among the packets that the mask `icmp` selects."""
    identifiers = np.full_like(transport, NO_ECHO)
    at = transport[icmp]
    kind, identifier = integers.u8(at), integers.u16(at + 4)
    identifiers[icmp] = np.select(
        [kind == _ICMP_ECHO_REQUEST, kind == _ICMP_ECHO_REPLY], [identifier, identifier + ECHO_REPLY], NO_ECHO
    )
    return identifiers


def _content_hashes(integers: Integers, at: Ints, captured: Ints, content_bytes: Ints) -> Ints:
    """Return a hash of the first `CONTENT_BYTES` of the content at each position."""
    words = integers.fields(_CONTENT, at)
    hashed_bytes = np.clip(content_bytes, 0, CONTENT_BYTES)
    short = np.flatnonzero(hashed_bytes < CONTENT_BYTES)
    columns = [words[str(start)] for start in range(0, CONTENT_BYTES, 8)]
    for number, word in enumerate(columns):
        # Set the bytes after the end of a short packet to 0. The first byte of a little-endian word is the lowest.
        word[short] &= _FIRST_BYTES_MASKS[np.clip(hashed_bytes[short] - 8 * number, 0, 8)]
    hashes = (row_hashes(*columns) >> np.uint64(1)).astype(np.int64)
    hashes[captured < hashed_bytes] = NOT_CAPTURED
    return hashes


def _equals(column: Addresses, text: str) -> Mask:
    upper, lower = address(text)
    equal: Mask = (column[:, 0] == upper) & (column[:, 1] == lower)
    return equal
