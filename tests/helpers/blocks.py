"""pcapng files for tests, built from blocks without the code under test."""

import struct
from collections.abc import Iterable

from tests.helpers.captures import Frame

PADDING = b"\x00" * 3


def block(kind: int, body: bytes, *, order: str = "<") -> bytes:
    body += PADDING[: -len(body) % 4]
    length = 12 + len(body)
    return struct.pack(f"{order}II", kind, length) + body + struct.pack(f"{order}I", length)


def section(*, order: str = "<") -> bytes:
    return block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1), order=order)


def option(code: int, value: bytes, *, order: str = "<") -> bytes:
    return struct.pack(f"{order}HH", code, len(value)) + value + PADDING[: -len(value) % 4]


def interface(
    link_type: int = 101,
    *,
    order: str = "<",
    snap: int = 0,
    resolution: int | None = None,
    offset_s: int | None = None,
) -> bytes:
    options = option(2, b"wlan0", order=order)
    if resolution is not None:
        options += option(9, bytes([resolution]), order=order)
    if offset_s is not None:
        options += option(14, struct.pack(f"{order}q", offset_s), order=order)
    options += option(0, b"", order=order)
    return block(1, struct.pack(f"{order}HHI", link_type, 0, snap) + options, order=order)


def _wire_bytes(frame: Frame) -> int:
    return len(frame.data) if frame.wire_bytes is None else frame.wire_bytes


def enhanced(frame: Frame, *, ticks: int, number: int = 0, order: str = "<", comment: bytes = b"") -> bytes:
    header = struct.pack(f"{order}5I", number, ticks >> 32, ticks & 0xFFFFFFFF, len(frame.data), _wire_bytes(frame))
    options = option(1, comment, order=order) + option(0, b"", order=order) if comment else b""
    return block(6, header + frame.data + PADDING[: -len(frame.data) % 4] + options, order=order)


def obsolete(frame: Frame, *, ticks: int, number: int = 0, order: str = "<", drops: int = 0) -> bytes:
    times = (ticks >> 32, ticks & 0xFFFFFFFF, len(frame.data), _wire_bytes(frame))
    return block(2, struct.pack(f"{order}HH4I", number, drops, *times) + frame.data, order=order)


def simple(frame: Frame, *, order: str = "<") -> bytes:
    return block(3, struct.pack(f"{order}I", _wire_bytes(frame)) + frame.data, order=order)


def file_bytes_of(frames: Iterable[Frame], *, order: str = "<", link_type: int = 101) -> bytes:
    """A section with one interface with nanosecond timestamps, and an enhanced packet block per frame."""
    blocks = [enhanced(frame, ticks=frame.time_ns, order=order) for frame in frames]
    return b"".join([section(order=order), interface(link_type, order=order, resolution=9), *blocks])
