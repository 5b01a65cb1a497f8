"""Headers of the link layer: for each link type, a function that finds the IP headers of frames.

Sources: https://www.tcpdump.org/linktypes.html, https://www.radiotap.org, IEEE 802.1Q, IEEE 802.11-2020 section 9.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import LITTLE, Frames, Integers, Ints, Mask
from fieldkit.measure.captures.headers import COOKED_V2, NO_HEADER

HeaderFinder = Callable[[Integers, Frames], Ints]
"""Function that returns the position of the IP header of each frame; `NO_HEADER` for a frame without one."""

# EtherTypes of IPv4 and IPv6, and of VLAN tags.
_IP_TYPES: Final = (0x0800, 0x86DD)
_TAG_TYPES: Final = (0x8100, 0x88A8, 0x9100)
# AF_INET of all systems, AF_INET6 of Linux, NetBSD, FreeBSD, macOS.
_IP_FAMILIES: Final = (2, 10, 24, 28, 30)
# The LLC header of a SNAP frame: DSAP and SSAP 0xAA, control 0x03, and the first byte of the OUI.
_SNAP: Final = 0xAAAA0300
_RADIOTAP_HEADER_BYTES: Final = 8
# Bits of radiotap's field `flags`. The FCS is the frame check sequence.
_RADIOTAP_PADDED: Final = 0x20
_RADIOTAP_WRONG_FCS: Final = 0x40


def _after_ethertype(integers: Integers, frames: Frames, type_at: Ints, network: Ints) -> Ints:
    """Return the positions of the IP headers after the EtherTypes; VLAN tags are skipped.

    Args:
        integers: Reader of integers in the file.
        frames: Frames of the file.
        type_at: Positions of the EtherTypes.
        network: Positions of the payloads whose type the EtherTypes state.
    """
    type_at, network = type_at.copy(), network.copy()
    ethertype = integers.u16(type_at)
    end = frames.start + frames.captured_bytes
    tagged = np.flatnonzero(_is_in(ethertype, _TAG_TYPES))
    while len(tagged):
        type_at[tagged] = network[tagged] + 2
        network[tagged] += 4
        ethertype[tagged] = integers.u16(type_at[tagged])
        tagged = tagged[_is_in(ethertype[tagged], _TAG_TYPES) & (network[tagged] < end[tagged])]
    return np.where(_is_in(ethertype, _IP_TYPES), network, NO_HEADER)


def _ethernet(integers: Integers, frames: Frames) -> Ints:
    return _after_ethertype(integers, frames, frames.start + 12, frames.start + 14)


def _cooked(integers: Integers, frames: Frames) -> Ints:
    return _after_ethertype(integers, frames, frames.start + 14, frames.start + 16)


def _cooked_v2(integers: Integers, frames: Frames) -> Ints:
    return _after_ethertype(integers, frames, frames.start, frames.start + 20)


def _null(integers: Integers, frames: Frames) -> Ints:
    """Return the positions of the IP headers, which follow the address family in loopback frames.

    The address family has the byte order of the capturing machine, so both orders are accepted.
    """
    family = integers.u32(frames.start)
    is_ip = _is_in(family, _IP_FAMILIES) | _is_in(family, [number << 24 for number in _IP_FAMILIES])
    return np.where(is_ip, frames.start + 4, NO_HEADER)


def _radiotap(integers: Integers, frames: Frames) -> Ints:
    """Return the positions of the IP headers after radiotap headers.

    `NO_HEADER` if the FCS is wrong, or if `_after_mac_header` finds no IP header.
    """
    little = integers.with_order(LITTLE)
    length = little.u16(frames.start + 2)
    end = frames.start + np.minimum(length, frames.captured_bytes)
    present = little.u32(frames.start + 4)
    fields_at = frames.start + _RADIOTAP_HEADER_BYTES
    # Bit 31 of a word of presence bits shows that another such word follows.
    extended = np.flatnonzero(present >> 31)
    while len(extended):
        is_extended = little.u32(fields_at[extended]) >> 31 == 1
        fields_at[extended] += 4
        extended = extended[is_extended & (fields_at[extended] < end[extended])]
    # The flags follow the time stamp, if there is one. The time stamp is aligned to 8 bytes.
    has_timestamp = present & 1 == 1
    flags_at = np.where(has_timestamp, frames.start + (fields_at - frames.start + 7) // 8 * 8 + 8, fields_at)
    flags = np.where((present & 2 == 2) & (flags_at < end), integers.u8(flags_at), 0)
    network = _after_mac_header(integers, frames, frames.start + length, padded=flags & _RADIOTAP_PADDED != 0)
    is_version_0 = integers.u8(frames.start) == 0
    return np.where(is_version_0 & (flags & _RADIOTAP_WRONG_FCS == 0), network, NO_HEADER)


def _80211(integers: Integers, frames: Frames) -> Ints:
    return _after_mac_header(integers, frames, frames.start, padded=np.zeros(len(frames), dtype=np.bool_))


def _after_mac_header(integers: Integers, frames: Frames, mac: Ints, *, padded: Mask) -> Ints:
    """Return the positions of the IP headers in data frames of IEEE 802.11; `NO_HEADER` for other frames.

    Args:
        integers: Reader of integers in the file.
        frames: Frames of the file.
        mac: Positions of the MAC headers.
        padded: Mask of the frames whose MAC header is padded to a multiple of four bytes.
    """
    kind, flags = integers.u8(mac), integers.u8(mac + 1)
    qos = kind & 0x80 != 0
    four_addresses = flags & 0x03 == 0x03
    header = 24 + 6 * four_addresses + 2 * qos
    qos_at = header - 2
    aggregated = qos & (integers.u8(mac + qos_at) & 0x80 != 0)
    header = header + 4 * (qos & (flags & 0x80 != 0))  # HT control
    llc = mac + np.where(padded, (header + 3) // 4 * 4, header)
    # In a mesh, a control field of 6 bytes and up to 2 addresses follow the MAC header (9.2.4.7.3). Outside of a
    # mesh, the bit that announces it has another meaning.
    may_be_mesh = qos & (integers.u8(mac + qos_at + 1) & 0x01 != 0) & (integers.u32(llc) != _SNAP)
    llc += may_be_mesh * (6 + 6 * (integers.u8(llc) & 0x03))
    # The mask selects data frames of version 0, except null frames, encrypted frames, later fragments, and A-MSDUs,
    # which contain several packets.
    readable = (kind & 0x4F == 0x08) & (flags & 0x40 == 0) & (integers.u8(mac + 22) & 0x0F == 0) & ~aggregated
    readable &= (integers.u32(llc) == _SNAP) & (integers.u16(llc + 4) == 0)
    return np.where(readable, _after_ethertype(integers, frames, llc + 6, llc + 8), NO_HEADER)


def _is_in(values: Ints, allowed: tuple[int, ...] | list[int]) -> Mask:
    mask: Mask = values == allowed[0]
    for value in allowed[1:]:
        mask |= values == value
    return mask


LINKS: Final[Mapping[int, HeaderFinder]] = MappingProxyType(
    {
        0: _null,  # BSD loopback
        1: _ethernet,
        105: _80211,  # IEEE 802.11 without radiotap
        108: _null,  # OpenBSD loopback
        113: _cooked,  # Linux, captured on all interfaces
        127: _radiotap,
        COOKED_V2: _cooked_v2,  # the same, by tcpdump 4.99 and later
    }
)
"""Function that finds the IP headers, by link type number. The types of `headers.RAW_LINKS` need no function."""
