"""pcapng files. A scan finds the block boundaries; then the packets of all packet blocks are read together.

File format: draft-ietf-opsawg-pcapng. A section has its own byte order and its own interfaces.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import BIG, LITTLE, NO_TIME, Buffer, Chunk, Frames, Integers, Ints, Mask, Order
from fieldkit.measure.captures.headers import check_link_type

MAGIC: Final = b"\x0a\x0d\x0d\x0a"
"""First four bytes of a file in either byte order: the block type of a section header."""

# Block types.
_SECTION: Final = 0x0A0D0D0A
_INTERFACE: Final = 1
_OBSOLETE_PACKET: Final = 2
_SIMPLE_PACKET: Final = 3
_ENHANCED_PACKET: Final = 6
_PACKETS: Final = frozenset({_OBSOLETE_PACKET, _SIMPLE_PACKET, _ENHANCED_PACKET})
_DEFINITIONS: Final = frozenset({_SECTION, _INTERFACE})
_ORDERS: Final[dict[bytes, Order]] = {b"\x1a\x2b\x3c\x4d": BIG, b"\x4d\x3c\x2b\x1a": LITTLE}
# Smallest lengths of a section header, an interface description and any block.
_SECTION_BYTES: Final = 28
_INTERFACE_BYTES: Final = 20
_SMALLEST_BLOCK_BYTES: Final = 12
# Snap length that is larger than any 32-bit packet length.
_NO_LIMIT: Final = 1 << 32
# Wireshark's WTAP_MAX_PACKET_SIZE_STANDARD, which equals libpcap's MAXIMUM_SNAPLEN.
_MAX_CAPTURED_BYTES: Final = 262_144
# Each section header and interface description starts a new chunk. Merged files have a few of them. Reading this many
# short chunks takes 1 s.
_MAX_DEFINITIONS: Final = 1_000


@dataclass(frozen=True)
class _Section:
    """Byte order of a section, and the interfaces that were described before the current position."""

    order: Order
    interfaces: tuple["Interface", ...] = ()


def chunks(data: Buffer, *, where: str, chunk_bytes: int) -> Iterator[Chunk]:
    """Yield the frames of a file in chunks of about `chunk_bytes`; there is at least one chunk.

    All frames of a chunk have the same section and interfaces. Frames of an unknown link type are included if another
    interface of the section has a known link type.

    Raises:
        EvidenceError: The file does not start with a complete section header, a section with packets has no interface
            of a known link type, or the file has more than `_MAX_DEFINITIONS` sections and interfaces.
    """
    if _next_definition(_Section(LITTLE), data, 0) is None:
        raise EvidenceError("has no complete section header", where=where, remedy="repeat the measurement")
    size = len(data)
    section, at, count, damage = _Section(LITTLE), 0, 0, None
    definitions = 0
    while not damage and at < size:
        end = min(at + chunk_bytes, size)
        starts, at = _scan(data, section.order, at, min(end, size - _SMALLEST_BLOCK_BYTES + 1))
        if at > size:
            at = starts.pop()
        frames, valid = _frames(data, section, np.array(starts, dtype=np.int64))
        if not valid.all():
            frames = frames.where(slice(0, int(valid.argmin())))
            damage = f"no packet block at byte {starts[len(frames)]}"
        if len(frames):
            check_link_type(*(interface.link_type for interface in section.interfaces), where=where)
        if at < end and not damage:
            definition = _next_definition(section, data, at)
            if definition is None:
                damage = _describe_damage(data, section.order, at)
            else:
                section, at = definition
                definitions += 1
        if definitions > _MAX_DEFINITIONS:
            reason = f"has more than {_MAX_DEFINITIONS} sections and interfaces"
            raise EvidenceError(reason, where=where, remedy="repeat the measurement")
        count += len(frames)
        if len(frames) or damage or at == size:
            yield Chunk(frames, damage and f"{damage}, after packet {count}")


def _scan(data: Buffer, order: Order, at: int, stop: int) -> tuple[list[int], int]:
    """Return the positions of the packet blocks from `at` on and before `stop`, and the position after the scan.

    The scan stops early at a section header, an interface description or an invalid block.
    """
    header = struct.Struct(f"{order}2I").unpack_from
    starts: list[int] = []
    while at < stop:
        kind, length = header(data, at)
        if kind in _PACKETS and length >= _SMALLEST_BLOCK_BYTES:
            starts.append(at)
        elif kind in _DEFINITIONS or not _is_complete_block(data, order, at):
            break
        at += length
    return starts, at


def _frames(data: Buffer, section: _Section, start: Ints) -> tuple[Frames, Mask]:
    """Return the frames of the blocks at the positions `start`, and a mask of the valid blocks."""
    integers = Integers(data, section.order)
    kind, length = integers.u32(start), integers.u32(start + 4)
    simple = kind == _SIMPLE_PACKET
    interface_index = np.where(kind == _OBSOLETE_PACKET, integers.u16(start + 8), integers.u32(start + 8))
    interface_index[simple] = 0
    has_interface = interface_index < len(section.interfaces)
    wire = integers.u32(start + np.where(simple, 8, 24))
    captured = np.where(simple, np.minimum(wire, _snap_bytes(section)), integers.u32(start + 20))
    link_type, time_ns = np.zeros_like(start), np.zeros_like(start)
    high, low = integers.u32(start + 12).astype(np.uint64), integers.u32(start + 16).astype(np.uint64)
    for index in np.flatnonzero(np.bincount(interface_index[has_interface])).tolist():
        rows = np.flatnonzero(interface_index == index)
        link_type[rows] = section.interfaces[index].link_type
        time_ns[rows] = section.interfaces[index].time_ns(high[rows] << np.uint64(32) | low[rows])
    time_ns[simple] = NO_TIME
    frames = Frames(
        start=start + np.where(simple, 12, 28),
        captured_bytes=captured,
        wire_bytes=wire,
        time_ns=time_ns,
        link_type=link_type,
    )
    valid = has_interface & (captured <= np.minimum(wire, _MAX_CAPTURED_BYTES))
    valid &= (captured <= length - np.where(simple, 16, 32)) & (length % 4 == 0)
    return frames, valid & (integers.u32(start + length - 4) == length)


def _snap_bytes(section: _Section) -> int:
    """Return the snap length of simple packet blocks: the snap length of the first interface of the section.

    `_NO_LIMIT` if this is 0; 0 if the section has no interface.
    """
    return section.interfaces[0].snap_bytes or _NO_LIMIT if section.interfaces else 0


def _next_definition(section: _Section, data: Buffer, at: int) -> tuple[_Section, int] | None:
    """Read a section header or an interface description at `at`.

    Returns:
        The new section, or the current section with the interface added; and the position after the block. None if
        the block at `at` has another type, is incomplete or is invalid.
    """
    order = section.order
    kind = bytes(data[at : at + 4])
    if kind == MAGIC:
        new_order = _ORDERS.get(bytes(data[at + 8 : at + 12]))
        if new_order is None or not _is_complete_block(data, new_order, at, min_bytes=_SECTION_BYTES):
            return None
        return _Section(new_order), at + _block_length(data, new_order, at)
    if kind != struct.pack(f"{order}I", _INTERFACE) or not _is_complete_block(
        data, order, at, min_bytes=_INTERFACE_BYTES
    ):
        return None
    end = at + _block_length(data, order, at)
    interface = parse_interface(bytes(data[at + 8 : end - 4]), order)
    return None if interface is None else (_Section(order, (*section.interfaces, interface)), end)


def _block_length(data: Buffer, order: Order, at: int) -> int:
    length: int = struct.unpack_from(f"{order}I", data, at + 4)[0]
    return length


def _is_complete_block(data: Buffer, order: Order, at: int, *, min_bytes: int = _SMALLEST_BLOCK_BYTES) -> bool:
    """Return True if a block of at least `min_bytes` is at `at`, and its two length fields are equal."""
    if len(data) - at < min_bytes:
        return False
    length = _block_length(data, order, at)
    if length < min_bytes or length % 4 or at + length > len(data):
        return False
    return bytes(data[at + 4 : at + 8]) == bytes(data[at + length - 4 : at + length])


def _describe_damage(data: Buffer, order: Order, at: int) -> str:
    """Return a description of the damage at `at`, a position without a complete block."""
    remaining = len(data) - at
    block_order: Order | None = order
    if bytes(data[at : at + 4]) == MAGIC:
        block_order = _ORDERS.get(bytes(data[at + 8 : at + 12]))
    if remaining < _SMALLEST_BLOCK_BYTES or (block_order and remaining < _block_length(data, block_order, at)):
        return f"ends inside the block at byte {at}"
    return f"no block at byte {at}"


# Options of an interface description: opt_endofopt, if_tsresol, if_tsoffset.
_END_OF_OPTIONS: Final = 0
_RESOLUTION: Final = 9
_OFFSET: Final = 14
_NS: Final = 1_000_000_000
# With at most this many ticks per second, the ticks of one second times 10**9 fit into 64 bits.
_MAX_TICKS_PER_S: Final = 1 << 34


@dataclass(frozen=True)
class Interface:
    """One interface of a section.

    Attributes:
        link_type: Link type number (https://www.tcpdump.org/linktypes.html).
        snap_bytes: Snap length; 0 for no limit.
        ticks_per_s: Number of units of the time stamps in one second.
        offset_s: Offset in seconds that is added to the time stamps.
    """

    link_type: int
    snap_bytes: int
    ticks_per_s: int = 1_000_000
    offset_s: int = 0

    def time_ns(self, ticks: NDArray[np.uint64]) -> Ints:
        """Convert time stamps to nanoseconds since 1970 UTC, rounded down."""
        ticks_per_s = self.ticks_per_s
        if ticks_per_s > _MAX_TICKS_PER_S:
            ticks = np.array([tick * _NS // ticks_per_s for tick in ticks.tolist()], dtype=np.uint64)
            ticks_per_s = _NS
        seconds, remaining_ticks = np.divmod(ticks, np.uint64(ticks_per_s))
        fraction_ns = remaining_ticks * np.uint64(_NS) // np.uint64(ticks_per_s)
        return (seconds.astype(np.int64) + self.offset_s) * _NS + fraction_ns.astype(np.int64)


def parse_interface(body: bytes, order: Order) -> Interface | None:
    """Return the interface described by the body of an interface description block.

    None if an option extends beyond the end of the block.
    """
    link_type, _, snap_bytes = struct.unpack_from(f"{order}HHI", body)
    ticks_per_s, offset_s = 1_000_000, 0
    at = 8
    while at + 4 <= len(body):
        code, size = struct.unpack_from(f"{order}HH", body, at)
        value = body[at + 4 : at + 4 + size]
        if code == _END_OF_OPTIONS:
            break
        if len(value) < size:
            return None
        if code == _RESOLUTION and size == 1:
            ticks_per_s = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif code == _OFFSET and size == 8:
            (offset_s,) = struct.unpack(f"{order}q", value)
        at += 4 + (size + 3) // 4 * 4
    return Interface(link_type, snap_bytes, ticks_per_s, offset_s)
