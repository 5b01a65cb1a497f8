"""IP packets as numpy columns: every field of all packets at once, from where each frame starts.

Headers: RFC 9293 (TCP), RFC 768 (UDP).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import BIG, Frames, Integers, Ints, Mask, Table, layout
from fieldkit.measure.captures.ip import SCTP, TCP, UDP, Addresses, address, headers
from fieldkit.measure.captures.links import network

SYN: Final = 0x02

_TRANSPORT: Final = layout(
    BIG, 20, sport=(0, 2), dport=(2, 2), udp_bytes=(4, 2), seq=(4, 4), ack=(8, 4), length=(12, 1), flags=(13, 1)
)

NO_PORT: Final = -1
"""Port of a packet that carries none: a later fragment, or another protocol."""


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
        ip_payload_bytes: Bytes after the IP header and its extensions, by the header (not by what was kept).
        sport: Source port of TCP, UDP and SCTP; `NO_PORT` where the packet carries none.
        dport: Destination port, likewise.
        tcp_seq: TCP sequence number; 0 without a TCP header.
        tcp_ack: TCP acknowledgment number; 0 without a TCP header.
        tcp_flags: TCP flags; 0 without a TCP header.
        tcp_mss: Largest segment that a SYN announces as its sender's limit; 0 in all others, and where it tells none.
        tcp_payload_bytes: Bytes after the TCP header; 0 without one.
        udp_bytes: Length in the UDP header, itself included; 0 without one.
    """

    time_ns: Ints
    wire_bytes: Ints
    src: Addresses
    dst: Addresses
    protocol: Ints
    ip_id: Ints
    fragment_offset: Ints
    more_fragments: Mask
    ip_payload_bytes: Ints
    sport: Ints
    dport: Ints
    tcp_seq: Ints
    tcp_ack: Ints
    tcp_flags: Ints
    tcp_mss: Ints
    tcp_payload_bytes: Ints
    udp_bytes: Ints

    def are_from(self, text: str) -> Mask:
        """Return which packets have this IPv4 or IPv6 source address."""
        return _equals(self.src, text)

    def are_to(self, text: str) -> Mask:
        """Return which packets have this IPv4 or IPv6 destination address."""
        return _equals(self.dst, text)


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
    tcp, udp = is_tcp & (kept >= 20), is_udp & (kept >= 8)
    head = integers.fields(_TRANSPORT, transport)
    tcp_header = (head["length"] >> 4) * 4
    tcp_flags = np.where(tcp, head["flags"], 0)
    return Packets(
        time_ns=frames.time_ns,
        wire_bytes=frames.wire_bytes,
        src=ip.src,
        dst=ip.dst,
        protocol=protocol,
        ip_id=ip.ip_id,
        fragment_offset=ip.fragment_offset,
        more_fragments=ip.more_fragments,
        ip_payload_bytes=payload,
        sport=np.where(ports, head["sport"], NO_PORT),
        dport=np.where(ports, head["dport"], NO_PORT),
        tcp_seq=np.where(tcp, head["seq"], 0),
        tcp_ack=np.where(tcp, head["ack"], 0),
        tcp_flags=tcp_flags,
        tcp_mss=_mss(integers, np.flatnonzero(tcp_flags & SYN), transport, np.minimum(kept, tcp_header)),
        tcp_payload_bytes=np.where(tcp, np.maximum(payload - tcp_header, 0), 0),
        udp_bytes=np.where(udp, head["udp_bytes"], 0),
    )


def _mss(integers: Integers, syn: Ints, transport: Ints, header_bytes: Ints) -> Ints:
    """Return the maximum segment size option (RFC 9293, section 3.7.1) of the packets `syn`, and 0 of all others."""
    found = np.zeros_like(transport)
    at, end = transport[syn] + 20, (transport + header_bytes)[syn]
    going_on = at + 4 <= end
    while going_on.any():
        syn, at, end = syn[going_on], at[going_on], end[going_on]
        kind = integers.u8(at)
        size = np.where(kind == 1, 1, integers.u8(at + 1))
        told = (kind == 2) & (size == 4)
        found[syn[told]] = integers.u16(at[told] + 2)
        at = at + size
        going_on = ~told & (kind != 0) & (size > 0) & (at + 4 <= end)
    return found


def _equals(column: Addresses, text: str) -> Mask:
    upper, lower = address(text)
    equal: Mask = (column[:, 0] == upper) & (column[:, 1] == lower)
    return equal
