"""IP headers of frames as columns: RFC 791 (IPv4), RFC 1071 (checksums). `ipv6_headers` decodes IPv6 headers."""

from dataclasses import dataclass
from functools import lru_cache
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import BIG, Fields, Frames, Integers, Ints, Mask, Table, layout

NO_HEADER: Final = -1
"""Position for a frame without an IP header."""

NO_INTERFACE: Final = -1
"""Interface index of a frame whose link-layer header contains no interface index."""

COOKED_V2: Final = 276
"""Link type of captures on all interfaces by tcpdump 4.99 and later (LINKTYPE_LINUX_SLL2)."""

RAW_LINKS: Final = frozenset((12, 14, 101, 228, 229))
"""Link types whose frames are IP packets: DLT_RAW of most systems, DLT_RAW of OpenBSD, LINKTYPE_RAW, IPv4, IPv6.

`link_layers` supports further link types.
"""


def check_link_type(*link_types: int, where: str) -> None:
    """Check that at least one of these link types is supported.

    Raises:
        EvidenceError: No link type is supported.
    """
    if RAW_LINKS & set(link_types):
        return
    from fieldkit.measure.captures.link_layers import LINKS  # noqa: PLC0415 (needed only for other link types)

    if not LINKS.keys() & set(link_types):
        raise EvidenceError(
            f"has no link type that fieldkit can read: {', '.join(map(str, link_types))}",
            where=where,
            remedy=f"capture on an interface of link type {', '.join(map(str, sorted(RAW_LINKS | LINKS.keys())))}",
        )


def ip_header_positions(integers: Integers, frames: Frames) -> Ints:
    """Return the position of each frame's IP header in the file; `NO_HEADER` if the link layer contains none.

    The header at this position may be truncated or invalid; `ip_headers` checks it.
    """
    header_at = np.full(len(frames), NO_HEADER)
    for link_type in np.flatnonzero(np.bincount(frames.link_type)).tolist():
        rows = np.flatnonzero(frames.link_type == link_type)
        if link_type in RAW_LINKS:
            header_at[rows] = frames.start[rows]
            continue
        from fieldkit.measure.captures.link_layers import LINKS  # noqa: PLC0415 (needed only for other link types)

        if link_type in LINKS:
            header_at[rows] = LINKS[link_type](integers, frames.where(rows))
    return header_at


def interfaces(integers: Integers, frames: Frames) -> Ints:
    """Return the index of each frame's interface; `NO_INTERFACE` if its link-layer header does not contain one."""
    cooked = frames.link_type == COOKED_V2
    if not cooked.any():
        return np.full(len(frames), NO_INTERFACE)
    return np.where(cooked, integers.u32(np.where(cooked, frames.start + 4, 0)), NO_INTERFACE)


ICMP: Final = 1
TCP: Final = 6
UDP: Final = 17
SCTP: Final = 132
"""IP protocol numbers."""

Addresses = NDArray[np.uint64]
"""Shape (n, 2): upper and lower half of each IPv6 address. IPv4 addresses are IPv4-mapped (RFC 4291, 2.5.5.2)."""

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
IPV6_HEADER_BYTES: Final = 40
"""Length of the fixed header of IPv6."""
_MAPPED: Final = 0xFFFF << 32
"""Lower half of the prefix of IPv4-mapped addresses, `::ffff:0:0/96`."""


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
        payload_bytes: Length of the payload according to the header, even if fewer bytes were captured. If the
            header has no length because of segmentation offload, it is computed from the length on the link.
        wrong_checksum: True if the header checksum of IPv4 is wrong and not 0; always False for IPv6.
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
    """Return the text form of an address that is given as two halves."""
    ipv6 = IPv6Address(upper << 64 | lower)
    return str(ipv6.ipv4_mapped or ipv6)


def ip_headers(integers: Integers, frames: Frames, at: Ints) -> Headers:
    """Return the complete and valid IP headers of `frames`.

    Args:
        integers: Reader of integers in the file.
        frames: The frames.
        at: Position of each frame's IP header; negative for a frame without one.
    """
    captured = np.where(at < 0, 0, frames.start + frames.captured_bytes - at)
    version = integers.u8(np.maximum(at, 0)) >> 4
    ipv4_frames = np.flatnonzero((version == 4) & (captured >= _IPV4_HEADER_BYTES))
    ipv6_frames = np.flatnonzero((version == 6) & (captured >= IPV6_HEADER_BYTES))
    wire = frames.wire_bytes - (at - frames.start)
    parts = [_ipv4_headers(integers, ipv4_frames, at[ipv4_frames], captured[ipv4_frames], wire[ipv4_frames])]
    if not len(ipv6_frames):
        return parts[0]
    from fieldkit.measure.captures.ipv6_headers import ipv6_headers  # noqa: PLC0415 (most captures contain no IPv6)

    headers = Headers.concatenated(
        [*parts, ipv6_headers(integers, ipv6_frames, at[ipv6_frames], captured[ipv6_frames], wire[ipv6_frames])]
    )
    return headers.where(np.argsort(headers.frame))


def _ipv4_headers(integers: Integers, frame: Ints, at: Ints, captured: Ints, wire: Ints) -> Headers:
    """Return the valid IPv4 headers at the positions `at`."""
    head = integers.fields(_IPV4, at)
    header = (head["length"] & 0xF) * 4
    # Segmentation offload leaves the total length 0 in frames above 64 KiB; the wire length is used instead.
    total = np.where(head["total"] == 0, wire, head["total"])
    fragment = head["fragment"]
    ipv4 = Headers(
        frame=frame,
        src=_to_ipv4_mapped(head["src"]),
        dst=_to_ipv4_mapped(head["dst"]),
        protocol=head["protocol"],
        ip_id=head["ip_id"],
        fragment_offset=(fragment & 0x1FFF) * 8,
        more_fragments=fragment & 0x2000 != 0,
        header_bytes=header,
        payload_at=at + header,
        payload_bytes=total - header,
        wrong_checksum=_has_wrong_checksum(integers, head, at, np.minimum(header, captured)),
    )
    valid = (header >= _IPV4_HEADER_BYTES) & (header <= captured) & (total >= header)
    return ipv4 if valid.all() else ipv4.where(valid)


def _has_wrong_checksum(integers: Integers, head: Fields, at: Ints, header: Ints) -> Mask:
    """Return a mask of the headers with a wrong checksum (RFC 1071).

    The one's complement sum of the words of a valid header is 0xFFFF (-0).

    A checksum field of 0 is accepted, because on some systems the network adapter computes the checksum after the
    capture.
    Linux computes it before the capture, even with offload, and drops received packets with a wrong checksum.

    Args:
        integers: Reader of integers in the file.
        head: The headers without options.
        at: Position of each header.
        header: Captured length of each header including its options, in bytes.
    """
    total = head["word0"] + head["word1"] + head["word2"] + head["src"] + head["dst"]
    with_options = np.flatnonzero(header > _IPV4_HEADER_BYTES)
    option_at = _IPV4_HEADER_BYTES
    while len(with_options):
        total[with_options] += integers.u32(at[with_options] + option_at)
        option_at += 4
        with_options = with_options[header[with_options] > option_at]
    # 2**16 is 1 modulo 0xFFFF, so the one's complement sum of 32-bit words equals the sum of 16-bit words.
    wrong: Mask = (total % 0xFFFF != 0) & (head["checksum"] != 0)
    return wrong


def _to_ipv4_mapped(value: Ints) -> Addresses:
    halves = np.zeros((len(value), 2), dtype=np.uint64)
    halves[:, 1] = value | _MAPPED
    return halves
