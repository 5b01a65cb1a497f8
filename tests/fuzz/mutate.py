"""Changes of stored outputs, like those that faulty cables, faulty disks, people and attackers cause."""

import random
import re
import struct
from collections.abc import Callable, Sequence
from typing import Final

MAX_BYTES: Final = 1 << 20
"""Maximum input size; longer inputs reveal no other defects."""

_NUMBER: Final = re.compile(rb"-?[0-9]+(?:\.[0-9]+)?")
_NUMBERS: Final = (
    *(b"0", b"-1", b"1", b"-0.0", b"127", b"256", b"65535", b"65536", b"2147483648", b"4294967295", b"4294967296"),
    *(b"9223372036854775807", b"9223372036854775808", b"18446744073709551616", b"-9223372036854775809"),
    *(b"1e400", b"-1e400", b"1e-400", b"nan", b"inf", b"-inf", b".5", b"5.", b"0x10", b"010", b"1_000", b""),
    *(b"9" * 18, b"9" * 19, b"9" * 20, b"9" * 400, b"9" * 5000, b"0." + b"1" * 400),
)
_WORDS: Final = (
    *(
        b"\0",
        b"\n",
        b"\r",
        b"\r\n",
        b"\t",
        b" ",
        b"\n\n\n",
        b"\xff",
        b"\xc3",
        b"\xed\xa0\x80",
        b"\x1b[2J",
        b"\xe2\x80\xae",
    ),
    *(
        b"[",
        b"]",
        b"{",
        b"}",
        b"(",
        b")",
        b":",
        b"- ",
        b"? ",
        b"#",
        b"'",
        b'"',
        b"|",
        b">",
        b"&a ",
        b"*a",
        b"!!",
        b"<<: ",
    ),
    *(
        b"[" * 3000,
        b"{" * 3000,
        b'{"a":' * 3000,
        b"- " * 3000,
        b"null",
        b"true",
        b"~",
        b"../",
        b"/",
        b"%",
        b"%s",
        b"{0}",
    ),
)
_SIZES: Final = (0, 1, 2, 7, 8, 15, 16, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 1 << 20, 1 << 28, (1 << 31) - 1)
_TIMES: Final = (2, 3, 10, 1000, 100_000)


def mutate(seed: bytes, others: Sequence[bytes], rng: random.Random) -> bytes:
    """Return `seed` with one to four changes, in most cases one; inserted data may be from `others`."""
    data = bytearray(seed)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        rng.choice(_CHANGES)(data, others, rng)
    return bytes(data[:MAX_BYTES])


def _position(data: bytearray, rng: random.Random) -> int:
    return rng.randrange(len(data) + 1)


def _range(data: bytes | bytearray, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.choice((1, 2, 4, 8, 16, 64, 512, 1 << 14)))


def _flip(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    for _time in range(rng.choice((1, 1, 1, 4, 32))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _set_byte(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.choice(
            (0, 1, 0x7F, 0x80, 0xFF, 0x20, 0x0A, 0x2D, 0x39, rng.randrange(256))
        )


def _truncate(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    del data[_position(data, rng) :]


def _delete(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    start, stop = _range(data, rng)
    del data[start:stop]


def _repeat(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    start, stop = _range(data, rng)
    max_times = max(1, (MAX_BYTES - len(data)) // max(1, stop - start))
    data[start:stop] = data[start:stop] * min(rng.choice(_TIMES), max_times)


def _repeat_line(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    lines = bytes(data).split(b"\n")
    position = rng.randrange(len(lines))
    max_times = max(1, (MAX_BYTES - len(data)) // (len(lines[position]) + 1))
    lines[position : position + 1] = lines[position : position + 1] * min(rng.choice(_TIMES), max_times)
    data[:] = b"\n".join(lines)


def _move_line(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    lines = bytes(data).split(b"\n")
    line = lines.pop(rng.randrange(len(lines)))
    lines.insert(rng.randrange(len(lines) + 1), line)
    data[:] = b"\n".join(lines)


def _insert(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    position = _position(data, rng)
    data[position:position] = rng.choice(_WORDS) * rng.choice((1, 1, 1, 3))


def _replace_number(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    start = _position(data, rng)
    match = _NUMBER.search(data, start) or _NUMBER.search(data)
    if match is not None:
        data[match.start() : match.end()] = rng.choice(_NUMBERS)


def _write_size(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    """Write a binary integer of 2, 4 or 8 bytes, as in headers, in either byte order."""
    form = rng.choice(("<H", ">H", "<I", ">I", "<Q", ">Q"))
    size = struct.calcsize(form)
    if len(data) >= size:
        value = rng.choice((*_SIZES, len(data), (1 << 8 * size) - 1, 1 << 8 * size - 1))
        struct.pack_into(form, data, rng.randrange(len(data) - size + 1), value & ((1 << 8 * size) - 1))


def _splice(data: bytearray, others: Sequence[bytes], rng: random.Random) -> None:
    other = rng.choice(others)
    start, stop = _range(other, rng)
    data_start, data_stop = _range(data, rng)
    data[data_start:data_stop] = other[start:stop]


def _copy(data: bytearray, _: Sequence[bytes], rng: random.Random) -> None:
    start, stop = _range(data, rng)
    position = _position(data, rng)
    data[position:position] = data[start:stop]


_CHANGES: Final[tuple[Callable[[bytearray, Sequence[bytes], random.Random], None], ...]] = (
    *(
        _flip,
        _set_byte,
        _truncate,
        _delete,
        _repeat,
        _repeat_line,
        _move_line,
        _insert,
        _replace_number,
        _replace_number,
        _write_size,
        _write_size,
    ),
    *(_splice, _copy),
)
