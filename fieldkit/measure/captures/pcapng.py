"""pcapng files: block boundaries by a scan, the packets of all blocks that hold one at once.

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
from fieldkit.measure.captures.links import check_link_type

MAGIC: Final = b"\x0a\x0d\x0d\x0a"
"""The first four bytes of a file, in either byte order: the type of a section's header."""

_SECTION: Final = 0x0A0D0D0A
_INTERFACE: Final = 1
_OBSOLETE_PACKET: Final = 2
_SIMPLE_PACKET: Final = 3
_ENHANCED_PACKET: Final = 6
_PACKETS: Final = frozenset({_OBSOLETE_PACKET, _SIMPLE_PACKET, _ENHANCED_PACKET})
_DEFINITIONS: Final = frozenset({_SECTION, _INTERFACE})
_ORDERS: Final[dict[bytes, Order]] = {b"\x1a\x2b\x3c\x4d": BIG, b"\x4d\x3c\x2b\x1a": LITTLE}
_SECTION_BYTES: Final = 28
_INTERFACE_BYTES: Final = 20
_SMALLEST_BLOCK_BYTES: Final = 12
_NO_LIMIT: Final = 1 << 32
# Wireshark's WTAP_MAX_PACKET_SIZE_STANDARD, which is libpcap's MAXIMUM_SNAPLEN too.
_MAX_CAPTURED_BYTES: Final = 262_144
# Each is a chunk of its own. Merged files have a few; so many short ones take 1 s, and more ever longer.
_MOST_DEFINITIONS: Final = 1_000


@dataclass(frozen=True)
class _Section:
    """What holds for the packets of a section, up to its next interface description."""

    order: Order
    interfaces: tuple["Interface", ...] = ()


def chunks(data: Buffer, *, where: str, chunk_bytes: int) -> Iterator[Chunk]:
    """Yield the frames of a file, at least one chunk, each of about `chunk_bytes` of it and one set of interfaces.

    Frames of interfaces whose link type is unknown are among them where another interface's is known.

    Raises:
        EvidenceError: It does not begin with a whole section header, has packets where no interface of the section is
            of a known link type, or more sections and interfaces than a file of captures.
    """
    if _redefined(_Section(LITTLE), data, 0) is None:
        raise EvidenceError("has no whole section header", where=where, remedy="repeat the measurement")
    size = len(data)
    section, at, count, damage = _Section(LITTLE), 0, 0, None
    definitions = 0
    while not damage and at < size:
        end = min(at + chunk_bytes, size)
        starts, at = _scan(data, section.order, at, min(end, size - _SMALLEST_BLOCK_BYTES + 1))
        if at > size:
            at = starts.pop()
        frames, sound = _frames(data, section, np.array(starts, dtype=np.int64))
        if not sound.all():
            frames = frames.where(slice(0, int(sound.argmin())))
            damage = f"no packet block at byte {starts[len(frames)]}"
        if len(frames):
            check_link_type(*(interface.link_type for interface in section.interfaces), where=where)
        if at < end and not damage:
            after = _redefined(section, data, at)
            if after is None:
                damage = _damage(data, section.order, at)
            else:
                section, at = after
                definitions += 1
        if definitions > _MOST_DEFINITIONS:
            what = f"has more than {_MOST_DEFINITIONS} sections and interfaces"
            raise EvidenceError(what, where=where, remedy="repeat the measurement")
        count += len(frames)
        if len(frames) or damage or at == size:
            yield Chunk(frames, damage and f"{damage}, after packet {count}")


def _scan(data: Buffer, order: Order, at: int, stop: int) -> tuple[list[int], int]:
    """Return where the packet blocks from `at` to before `stop` start, and where it ended.

    It ends earlier at a section header, at an interface description, and at what is no block.
    """
    header = struct.Struct(f"{order}2I").unpack_from
    starts: list[int] = []
    while at < stop:
        kind, length = header(data, at)
        if kind in _PACKETS and length >= _SMALLEST_BLOCK_BYTES:
            starts.append(at)
        elif kind in _DEFINITIONS or not _is_whole(data, order, at):
            break
        at += length
    return starts, at


def _frames(data: Buffer, section: _Section, start: Ints) -> tuple[Frames, Mask]:
    """Return the frames of the blocks that start at `start`, and which of them are sound."""
    integers = Integers(data, section.order)
    kind, length = integers.u32(start), integers.u32(start + 4)
    simple = kind == _SIMPLE_PACKET
    number = np.where(kind == _OBSOLETE_PACKET, integers.u16(start + 8), integers.u32(start + 8))
    number[simple] = 0
    wire = integers.u32(start + np.where(simple, 8, 24))
    captured = np.where(simple, np.minimum(wire, _snap_bytes(section)), integers.u32(start + 20))
    link_type, time_ns = np.zeros_like(start), np.zeros_like(start)
    high, low = integers.u32(start + 12).astype(np.uint64), integers.u32(start + 16).astype(np.uint64)
    for interface in np.flatnonzero(np.bincount(number[number < len(section.interfaces)])).tolist():
        its = np.flatnonzero(number == interface)
        link_type[its] = section.interfaces[interface].link_type
        time_ns[its] = section.interfaces[interface].time_ns(high[its] << np.uint64(32) | low[its])
    time_ns[simple] = NO_TIME
    frames = Frames(
        start=start + np.where(simple, 12, 28),
        captured_bytes=captured,
        wire_bytes=wire,
        time_ns=time_ns,
        link_type=link_type,
    )
    sound = (number < len(section.interfaces)) & (captured <= np.minimum(wire, _MAX_CAPTURED_BYTES))
    sound &= (captured <= length - np.where(simple, 16, 32)) & (length % 4 == 0)
    return frames, sound & (integers.u32(start + length - 4) == length)


def _snap_bytes(section: _Section) -> int:
    """Return how much a simple packet block kept at most: it is of the first interface."""
    return section.interfaces[0].snap_bytes or _NO_LIMIT if section.interfaces else 0


def _redefined(section: _Section, data: Buffer, at: int) -> tuple[_Section, int] | None:
    """Return what holds after the section header or interface description at `at`, and where that ends.

    None when neither stands there, or not a whole and sound one.
    """
    order = section.order
    kind = bytes(data[at : at + 4])
    if kind == MAGIC:
        found = _ORDERS.get(bytes(data[at + 8 : at + 12]))
        if found is None or not _is_whole(data, found, at, least=_SECTION_BYTES):
            return None
        return _Section(found), at + _length(data, found, at)
    if kind != struct.pack(f"{order}I", _INTERFACE) or not _is_whole(data, order, at, least=_INTERFACE_BYTES):
        return None
    end = at + _length(data, order, at)
    interface = described(bytes(data[at + 8 : end - 4]), order)
    return None if interface is None else (_Section(order, (*section.interfaces, interface)), end)


def _length(data: Buffer, order: Order, at: int) -> int:
    length: int = struct.unpack_from(f"{order}I", data, at + 4)[0]
    return length


def _is_whole(data: Buffer, order: Order, at: int, *, least: int = _SMALLEST_BLOCK_BYTES) -> bool:
    """Return whether a block stands at `at`, at least so long, with the same length at both its ends."""
    if len(data) - at < least:
        return False
    length = _length(data, order, at)
    if length < least or length % 4 or at + length > len(data):
        return False
    return bytes(data[at + 4 : at + 8]) == bytes(data[at + length - 4 : at + length])


def _damage(data: Buffer, order: Order, at: int) -> str:
    """Return what is wrong at `at`, where no whole block stands."""
    left = len(data) - at
    known: Order | None = order
    if bytes(data[at : at + 4]) == MAGIC:
        known = _ORDERS.get(bytes(data[at + 8 : at + 12]))
    if left < _SMALLEST_BLOCK_BYTES or (known and left < _length(data, known, at)):
        return f"ends inside the block at byte {at}"
    return f"no block at byte {at}"


_END_OF_OPTIONS: Final = 0
_RESOLUTION: Final = 9
_OFFSET: Final = 14
_NS: Final = 1_000_000_000
# Up to here the ticks within a second, in nanoseconds, need no more than 64 bits.
_MAX_TICKS_PER_S: Final = 1 << 34


@dataclass(frozen=True)
class Interface:
    """One interface of a section.

    Attributes:
        link_type: How its frames begin (https://www.tcpdump.org/linktypes.html).
        snap_bytes: How much of each frame was kept at most; 0 for all.
        ticks_per_s: Unit of its time stamps.
        offset_s: What to add to them, in seconds.
    """

    link_type: int
    snap_bytes: int
    ticks_per_s: int = 1_000_000
    offset_s: int = 0

    def time_ns(self, ticks: NDArray[np.uint64]) -> Ints:
        """Return time stamps in nanoseconds since 1970 UTC, rounded down."""
        ticks_per_s = self.ticks_per_s
        if ticks_per_s > _MAX_TICKS_PER_S:
            ticks = np.array([tick * _NS // ticks_per_s for tick in ticks.tolist()], dtype=np.uint64)
            ticks_per_s = _NS
        seconds, rest = np.divmod(ticks, np.uint64(ticks_per_s))
        rest_ns = rest * np.uint64(_NS) // np.uint64(ticks_per_s)
        return (seconds.astype(np.int64) + self.offset_s) * _NS + rest_ns.astype(np.int64)


def described(body: bytes, order: Order) -> Interface | None:
    """Return the interface that the body of a block describes, None when it describes none."""
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
