"""Headers of frames as columns: positions of the IP headers by link type, then IPv4 and IPv6 headers.

Extension headers are skipped. Headers: https://www.tcpdump.org/linktypes.html, https://www.radiotap.org, IEEE 802.1Q,
IEEE 802.11-2020 section 9; RFC 791 (IPv4), RFC 8200 (IPv6 and its extension headers), RFC 4302 (authentication),
RFC 2675 (jumbograms), RFC 1071 (checksums).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from ipaddress import IPv4Address, IPv6Address, ip_address
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import BIG, LITTLE, Fields, Frames, Integers, Ints, Mask, Table, layout

NO_HEADER: Final = -1
"""Position for a frame without an IP header."""

Finder = Callable[[Integers, Frames], Ints]

_IP_TYPES: Final = (0x0800, 0x86DD)
_TAG_TYPES: Final = (0x8100, 0x88A8, 0x9100)
# AF_INET of all systems, AF_INET6 of Linux, NetBSD, FreeBSD, macOS.
_IP_FAMILIES: Final = (2, 10, 24, 28, 30)
_SNAP: Final = 0xAAAA0300
_RADIOTAP_HEADER_BYTES: Final = 8


def _after_ethertype(integers: Integers, frames: Frames, type_at: Ints, network: Ints) -> Ints:
    """Return the position of the IP header after an EtherType, skipping VLAN tags.

    Args:
        integers: The file.
        frames: Its frames.
        type_at: Positions of the EtherTypes.
        network: Positions of the bytes that the EtherTypes describe.
    """
    type_at, network = type_at.copy(), network.copy()
    kind = integers.u16(type_at)
    end = frames.start + frames.captured_bytes
    tagged = np.flatnonzero(_is_in(kind, _TAG_TYPES))
    while len(tagged):
        type_at[tagged] = network[tagged] + 2
        network[tagged] += 4
        kind[tagged] = integers.u16(type_at[tagged])
        tagged = tagged[_is_in(kind[tagged], _TAG_TYPES) & (network[tagged] < end[tagged])]
    return np.where(_is_in(kind, _IP_TYPES), network, NO_HEADER)


def _ethernet(integers: Integers, frames: Frames) -> Ints:
    return _after_ethertype(integers, frames, frames.start + 12, frames.start + 14)


def _cooked(integers: Integers, frames: Frames) -> Ints:
    return _after_ethertype(integers, frames, frames.start + 14, frames.start + 16)


def _cooked_v2(integers: Integers, frames: Frames) -> Ints:
    return _after_ethertype(integers, frames, frames.start, frames.start + 20)


def _raw(_: Integers, frames: Frames) -> Ints:
    return frames.start


def _null(integers: Integers, frames: Frames) -> Ints:
    """Return the positions after the address family, whose byte order may differ from the byte order of the file."""
    family = integers.u32(frames.start)
    is_ip = _is_in(family, _IP_FAMILIES) | _is_in(family, [number << 24 for number in _IP_FAMILIES])
    return np.where(is_ip, frames.start + 4, NO_HEADER)


def _radiotap(integers: Integers, frames: Frames) -> Ints:
    """Skip the radiotap header. A frame with a bad checksum (FCS) counts as a frame without an IP header."""
    little = integers.with_order(LITTLE)
    length = little.u16(frames.start + 2)
    end = frames.start + np.minimum(length, frames.captured_bytes)
    present = little.u32(frames.start + 4)
    after = frames.start + _RADIOTAP_HEADER_BYTES
    extended = np.flatnonzero(present >> 31)
    while len(extended):
        more = little.u32(after[extended]) >> 31 == 1
        after[extended] += 4
        extended = extended[more & (after[extended] < end[extended])]
    # The flags follow the time stamp, which is aligned to 8 bytes.
    has_timestamp = present & 1 == 1
    flags_at = np.where(has_timestamp, frames.start + (after - frames.start + 7) // 8 * 8 + 8, after)
    flags = np.where((present & 2 == 2) & (flags_at < end), integers.u8(flags_at), 0)
    network = _from_80211(integers, frames, frames.start + length, padded=flags & 0x20 != 0)
    return np.where((integers.u8(frames.start) == 0) & (flags & 0x40 == 0), network, NO_HEADER)


def _80211(integers: Integers, frames: Frames) -> Ints:
    return _from_80211(integers, frames, frames.start, padded=np.zeros(len(frames), dtype=np.bool_))


def _from_80211(integers: Integers, frames: Frames, mac: Ints, *, padded: Mask) -> Ints:
    """Return the positions of the IP headers in data frames.

    Args:
        integers: The file.
        frames: Its frames.
        mac: Positions of their MAC headers.
        padded: Mask of frames whose MAC header is padded to a multiple of four bytes.
    """
    kind, flags = integers.u8(mac), integers.u8(mac + 1)
    qos = kind & 0x80 != 0
    four_addresses = flags & 0x03 == 0x03
    header = 24 + 6 * four_addresses + 2 * qos
    aggregated = qos & (integers.u8(mac + header - 2) & 0x80 != 0)
    header += 4 * (qos & (flags & 0x80 != 0))  # HT control
    llc = mac + np.where(padded, (header + 3) // 4 * 4, header)
    # Data frames of version 0, except null frames, encrypted frames, later fragments and aggregates (A-MSDU).
    readable = (kind & 0x4F == 0x08) & (flags & 0x40 == 0) & (integers.u8(mac + 22) & 0x0F == 0) & ~aggregated
    readable &= (integers.u32(llc) == _SNAP) & (integers.u16(llc + 4) == 0)
    return np.where(readable, _after_ethertype(integers, frames, llc + 6, llc + 8), NO_HEADER)


def _is_in(values: Ints, allowed: tuple[int, ...] | list[int]) -> Mask:
    mask: Mask = values == allowed[0]
    for value in allowed[1:]:
        mask |= values == value
    return mask


LINKS: Final[Mapping[int, Finder]] = MappingProxyType(
    {
        0: _null,  # BSD loopback
        1: _ethernet,
        12: _raw,  # DLT_RAW of most systems
        14: _raw,  # DLT_RAW of OpenBSD
        101: _raw,
        105: _80211,
        108: _null,  # OpenBSD loopback
        113: _cooked,
        127: _radiotap,
        228: _raw,  # IPv4
        229: _raw,  # IPv6
        276: _cooked_v2,
    }
)
"""Functions by link type number."""


def check_link_type(*link_types: int, where: str) -> None:
    """Check that at least one of these link types is supported.

    Raises:
        EvidenceError: No link type is supported.
    """
    if not LINKS.keys() & set(link_types):
        raise EvidenceError(
            f"has the link type {', '.join(map(str, link_types))}, which fieldkit cannot read",
            where=where,
            remedy=f"capture on an interface of link type {', '.join(map(str, LINKS))}",
        )


def network(integers: Integers, frames: Frames) -> Ints:
    """Return the position of each frame's IP header in the file; `NO_HEADER` if it has none or is unknown."""
    header_at = np.full(len(frames), NO_HEADER)
    for link_type in np.flatnonzero(np.bincount(frames.link_type)).tolist():
        if link_type in LINKS:
            chosen = np.flatnonzero(frames.link_type == link_type)
            header_at[chosen] = LINKS[link_type](integers, frames.where(chosen))
    return header_at


ICMP: Final = 1
TCP: Final = 6
UDP: Final = 17
SCTP: Final = 132

Addresses = NDArray[np.uint64]
"""Shape (n, 2): the halves of an IPv6 address, upper first; an IPv4 address as IPv4-mapped (RFC 4291, 2.5.5.2)."""

_IPV4_HEADER_BYTES: Final = 20
_IPV4: Final = layout(
    BIG,
    _IPV4_HEADER_BYTES,
    length=(0, 1),
    total=(2, 2),
    ip_id=(4, 2),
    fragment=(6, 2),
    protocol=(9, 1),
    checksum=(10, 2),
    src=(12, 4),
    dst=(16, 4),
    **{f"word{number}": (4 * number, 4) for number in range(3)},
)
_IPV6_HEADER_BYTES: Final = 40
_MAPPED: Final = 0xFFFF << 32
_HOP_BY_HOP: Final = 0
_FRAGMENT: Final = 44
_AUTHENTICATION: Final = 51
_JUMBO_OPTION: Final = 0xC204
# Hop-by-hop, routing, fragment, authentication, destination, mobility, host identity, shim6: one format, except for
# the encoding of the length.
_IS_EXTENSION: Final = np.isin(np.arange(256), (_HOP_BY_HOP, 43, _FRAGMENT, _AUTHENTICATION, 60, 135, 139, 140))


@dataclass(frozen=True, eq=False)
class Headers(Table):
    """IP headers.

    Attributes:
        frame: Index of the frame that contains the header.
        src: Source address.
        dst: Destination address.
        protocol: Protocol number after the extension headers.
        ip_id: Identification; 0 in an IPv6 packet that is not a fragment.
        fragment_offset: Fragment offset in bytes.
        more_fragments: True if more fragments follow.
        header_bytes: Length of the header and its extension headers.
        payload_at: Index of the first byte after the header and its extension headers in the file.
        payload_bytes: Length of the payload by the header, even if fewer bytes were captured.
        wrong_checksum: True if the header checksum of IPv4 is wrong.
    """

    frame: Ints
    src: Addresses
    dst: Addresses
    protocol: Ints
    ip_id: Ints
    fragment_offset: Ints
    more_fragments: Mask
    header_bytes: Ints
    payload_at: Ints
    payload_bytes: Ints
    wrong_checksum: Mask


@lru_cache(maxsize=64)
def address(text: str) -> tuple[int, int]:
    """Return the two halves of an IPv4 or IPv6 address as in `Addresses`."""
    parsed = ip_address(text)
    value = _MAPPED | int(parsed) if isinstance(parsed, IPv4Address) else int(parsed)
    return value >> 64, value & (1 << 64) - 1


@lru_cache(maxsize=1024)
def address_text(upper: int, lower: int) -> str:
    """Return the usual text of an address whose two halves are given."""
    ipv6 = IPv6Address(upper << 64 | lower)
    return str(ipv6.ipv4_mapped or ipv6)


def ip_headers(integers: Integers, frames: Frames, at: Ints) -> Headers:
    """Return the complete and valid IP headers at the positions `at` in `frames`; a negative position has none."""
    captured = np.where(at < 0, 0, frames.start + frames.captured_bytes - at)
    version = integers.u8(np.maximum(at, 0)) >> 4
    ipv4_frames = np.flatnonzero((version == 4) & (captured >= _IPV4_HEADER_BYTES))
    ipv6_frames = np.flatnonzero((version == 6) & (captured >= _IPV6_HEADER_BYTES))
    wire = frames.wire_bytes - (at - frames.start)
    parts = [_ipv4(integers, ipv4_frames, at[ipv4_frames], captured[ipv4_frames], wire[ipv4_frames])]
    if not len(ipv6_frames):
        return parts[0]
    both = Headers.concatenated(
        [*parts, _ipv6(integers, ipv6_frames, at[ipv6_frames], captured[ipv6_frames], wire[ipv6_frames])]
    )
    return both.where(np.argsort(both.frame))


def _ipv4(integers: Integers, frame: Ints, at: Ints, captured: Ints, wire: Ints) -> Headers:
    head = integers.fields(_IPV4, at)
    header = (head["length"] & 0xF) * 4
    # Segmentation offload leaves the total length 0 in frames above 64 KiB; the wire length is used instead.
    total = np.where(head["total"] == 0, wire, head["total"])
    fragment = head["fragment"]
    ipv4 = Headers(
        frame=frame,
        src=_mapped(head["src"]),
        dst=_mapped(head["dst"]),
        protocol=head["protocol"],
        ip_id=head["ip_id"],
        fragment_offset=(fragment & 0x1FFF) * 8,
        more_fragments=fragment & 0x2000 != 0,
        header_bytes=header,
        payload_at=at + header,
        payload_bytes=total - header,
        wrong_checksum=_wrong_checksums(integers, head, at, np.minimum(header, captured)),
    )
    valid = (header >= _IPV4_HEADER_BYTES) & (header <= captured) & (total >= header)
    return ipv4 if valid.all() else ipv4.where(valid)


def _wrong_checksums(integers: Integers, head: Fields, at: Ints, header: Ints) -> Mask:
    """Return a mask of the headers whose checksum is wrong (RFC 1071: the words of a header add up to -0).

    A checksum of 0 was not computed: on some systems the adapter computes it, after the capture. Linux computes it
    before the capture, also with offload, and drops received packets in which it is wrong.

    Args:
        integers: The file.
        head: The headers without options.
        at: Position of each header.
        header: Length of each header with its options, as far as it was captured.
    """
    total = head["word0"] + head["word1"] + head["word2"] + head["src"] + head["dst"]
    longer = np.flatnonzero(header > _IPV4_HEADER_BYTES)
    option = _IPV4_HEADER_BYTES
    while len(longer):
        total[longer] += integers.u32(at[longer] + option)
        option += 4
        longer = longer[header[longer] > option]
    # 2**16 is 1 modulo 0xFFFF, so words of 32 bits have the same sum in one's complement as words of 16 bits.
    wrong: Mask = (total % 0xFFFF != 0) & (head["checksum"] != 0)
    return wrong


def _mapped(value: Ints) -> Addresses:
    halves = np.zeros((len(value), 2), dtype=np.uint64)
    halves[:, 1] = value | _MAPPED
    return halves


def _ipv6(integers: Integers, frame: Ints, at: Ints, captured: Ints, wire: Ints) -> Headers:
    end = at + captured
    protocol = integers.u8(at + 6)
    payload_end = at + _IPV6_HEADER_BYTES + _ipv6_payload_bytes(integers, at, captured, protocol, wire)
    payload_at = at + _IPV6_HEADER_BYTES
    ip_id, fragment = np.zeros_like(at), np.zeros_like(at)

    inside = np.flatnonzero(_IS_EXTENSION[protocol] & (payload_at + 8 <= end))
    while len(inside):
        header_at, kind = payload_at[inside], protocol[inside]
        units = integers.u8(header_at + 1)
        size = np.where(kind == _AUTHENTICATION, (units + 2) * 4, (units + 1) * 8)
        fragmented = kind == _FRAGMENT
        size[fragmented] = 8
        fragment[inside[fragmented]] = integers.u16(header_at[fragmented] + 2)
        ip_id[inside[fragmented]] = integers.u32(header_at[fragmented] + 4)
        protocol[inside] = integers.u8(header_at)
        payload_at[inside] = header_at + size
        # In a fragment other than the first, the data after the fragment header is payload.
        continues = _IS_EXTENSION[protocol[inside]] & (header_at + size + 8 <= end[inside]) & (fragment[inside] < 8)
        inside = inside[continues]
    return Headers(
        frame=frame,
        src=_halves(integers, at + 8),
        dst=_halves(integers, at + 24),
        protocol=protocol,
        ip_id=ip_id,
        fragment_offset=fragment & 0xFFF8,
        more_fragments=fragment & 1 == 1,
        header_bytes=payload_at - at,
        payload_at=payload_at,
        payload_bytes=np.maximum(payload_end - payload_at, 0),
        wrong_checksum=np.zeros(len(at), dtype=np.bool_),
    )


def _ipv6_payload_bytes(integers: Integers, at: Ints, captured: Ints, protocol: Ints, wire: Ints) -> Ints:
    """Return the payload length after the fixed header.

    If the length in the header is 0, it is read from the jumbo option or, for frames from segmentation offload,
    computed from the wire length.
    """
    payload_length = integers.u16(at + 4)
    jumbo = (protocol == _HOP_BY_HOP) & (captured >= 48) & (integers.u16(at + 42) == _JUMBO_OPTION)
    may_be_offloaded = (protocol == TCP) | (protocol == UDP)
    actual_length = np.where(jumbo, integers.u32(at + 44), np.where(may_be_offloaded, wire - _IPV6_HEADER_BYTES, 0))
    return np.where(payload_length == 0, actual_length, payload_length)


def _halves(integers: Integers, at: Ints) -> Addresses:
    return np.stack((integers.u64(at), integers.u64(at + 8)), axis=1)
