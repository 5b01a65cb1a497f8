"""IPv6 headers of frames as columns; extension headers are skipped.

RFC 8200 (IPv6 and its extension headers), RFC 4302 (authentication), RFC 2675 (jumbograms).
"""

from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Integers, Ints
from fieldkit.measure.captures.headers import IPV6_HEADER_BYTES, TCP, UDP, Addresses, Headers

# Types of extension headers.
_HOP_BY_HOP: Final = 0
_FRAGMENT: Final = 44
_AUTHENTICATION: Final = 51
# Type and length of the option with the length of a jumbogram.
_JUMBO_OPTION: Final = 0xC204
# Hop-by-hop, routing, fragment, authentication, destination, mobility, host identity and shim6 headers have the same
# format, except for the encoding of the length.
_IS_EXTENSION: Final = np.isin(np.arange(256), (_HOP_BY_HOP, 43, _FRAGMENT, _AUTHENTICATION, 60, 135, 139, 140))


def ipv6_headers(integers: Integers, frame: Ints, at: Ints, captured: Ints, wire: Ints) -> Headers:
    """Return the IPv6 headers of some frames.

    Args:
        integers: Reader of integers in the file.
        frame: Indices of the frames.
        at: Positions of the headers in the file.
        captured: Number of captured bytes from each position to the end of the frame.
        wire: Number of bytes on the link from each position to the end of the frame.
    """
    end = at + captured
    protocol = integers.u8(at + 6)
    payload_end = at + IPV6_HEADER_BYTES + _ipv6_payload_bytes(integers, at, captured, protocol, wire)
    payload_at = at + IPV6_HEADER_BYTES
    ip_id, fragment = np.zeros_like(at), np.zeros_like(at)

    unfinished = np.flatnonzero(_IS_EXTENSION[protocol] & (payload_at + 8 <= end))
    while len(unfinished):
        header_at, kind = payload_at[unfinished], protocol[unfinished]
        units = integers.u8(header_at + 1)
        size = np.where(kind == _AUTHENTICATION, (units + 2) * 4, (units + 1) * 8)
        is_fragment = kind == _FRAGMENT
        size[is_fragment] = 8
        fragment[unfinished[is_fragment]] = integers.u16(header_at[is_fragment] + 2)
        ip_id[unfinished[is_fragment]] = integers.u32(header_at[is_fragment] + 4)
        protocol[unfinished] = integers.u8(header_at)
        payload_at[unfinished] = header_at + size
        # In a fragment other than the first, the data after the fragment header is payload.
        continues = (
            _IS_EXTENSION[protocol[unfinished]]
            & (header_at + size + 8 <= end[unfinished])
            & (fragment[unfinished] < 8)
        )
        unfinished = unfinished[continues]
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

    If the length in the header is 0, it is read from the jumbo option. Without this option it is computed from the
    wire length if the next header is TCP or UDP (frames from segmentation offload), and otherwise it is 0.
    """
    payload_length = integers.u16(at + 4)
    jumbo = (protocol == _HOP_BY_HOP) & (captured >= 48) & (integers.u16(at + 42) == _JUMBO_OPTION)
    may_be_offloaded = (protocol == TCP) | (protocol == UDP)
    actual_length = np.where(jumbo, integers.u32(at + 44), np.where(may_be_offloaded, wire - IPV6_HEADER_BYTES, 0))
    return np.where(payload_length == 0, actual_length, payload_length)


def _halves(integers: Integers, at: Ints) -> Addresses:
    return np.stack((integers.u64(at), integers.u64(at + 8)), axis=1)
