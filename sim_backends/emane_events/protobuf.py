"""Fields of Protocol Buffers messages (protobuf.dev, "Encoding"): the wire types that EMANE's events use."""

import struct
from collections.abc import Iterator
from typing import Final

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Wire types. A varint is an integer in groups of 7 bits, the lowest first, each in a byte."""
_DOUBLE: Final = struct.Struct("<d")
_FLOAT: Final = struct.Struct("<f")
_MAX_VARINT_BYTES: Final = 10
"""Number of bytes of a varint with 64 bits."""
Value = int | bytes
"""Value of a varint, or the bytes of a field of another type."""


class MalformedEventError(ValueError):
    """The bytes are not an event."""


def varint_bytes(number: int) -> bytes:
    """Return a number as a varint.

    Raises:
        ValueError: The number is negative or above 2^64 - 1.
    """
    if not 0 <= number < 1 << 64:
        raise ValueError(f"{number} is not an unsigned integer of 64 bits")
    encoded = bytearray()
    while number > 0x7F:
        encoded.append(number & 0x7F | 0x80)
        number >>= 7
    encoded.append(number)
    return bytes(encoded)


def integer_field(field: int, number: int) -> bytes:
    """Return a field of type uint32 or uint64."""
    return varint_bytes(field << 3 | VARINT) + varint_bytes(number)


def double_field(field: int, number: float) -> bytes:
    """Return a field of type double."""
    return varint_bytes(field << 3 | FIXED64) + _DOUBLE.pack(number)


def float_field(field: int, number: float) -> bytes:
    """Return a field of type float."""
    return varint_bytes(field << 3 | FIXED32) + _FLOAT.pack(number)


def bytes_field(field: int, content: bytes) -> bytes:
    """Return a field of type bytes, or a message within a message."""
    return varint_bytes(field << 3 | BYTES) + varint_bytes(len(content)) + content


def fields(message: bytes) -> Iterator[tuple[int, Value]]:
    """Yield the number and the value of each field. Values of fixed size are returned as bytes.

    Raises:
        MalformedEventError: A field is longer than the message, or has a type that is not supported.
    """
    offset = 0
    while offset < len(message):
        key, offset = _varint(message, offset)
        field, kind = key >> 3, key & 7
        if kind == VARINT:
            number, offset = _varint(message, offset)
            yield field, number
            continue
        if kind == BYTES:
            size, offset = _varint(message, offset)
        elif kind in {FIXED64, FIXED32}:
            size = 8 if kind == FIXED64 else 4
        else:
            raise MalformedEventError(f"field {field} has the type {kind}")
        if size > len(message) - offset:
            raise MalformedEventError(f"field {field} of {size} bytes is longer than its message")
        yield field, message[offset : offset + size]
        offset += size


def fields_by_number(message: bytes, required: tuple[int, ...]) -> dict[int, Value]:
    """Return the values of the fields of a message by number; the last value, if a field is repeated.

    Raises:
        MalformedEventError: See `fields`; or a required field is missing.
    """
    values = dict(fields(message))
    missing = [field for field in required if field not in values]
    if missing:
        raise MalformedEventError(f"field {missing[0]} is missing")
    return values


def as_integer(value: Value, below: int = 1 << 64) -> int:
    """Return the value of an integer field.

    Raises:
        MalformedEventError: The field is not an integer, or its value is too large.
    """
    if not isinstance(value, int) or value >= below:
        raise MalformedEventError("a field is not an integer of the expected size")
    return value


def as_bytes(value: Value) -> bytes:
    """Return the value of a field of bytes.

    Raises:
        MalformedEventError: The field is an integer.
    """
    if isinstance(value, int):
        raise MalformedEventError("a field is an integer instead of bytes")
    return value


def as_real(value: Value) -> float:
    """Return the value of a field of type double or float.

    Raises:
        MalformedEventError: The field is an integer, or has another size than a double or a float.
    """
    content = as_bytes(value)
    if len(content) not in {_DOUBLE.size, _FLOAT.size}:
        raise MalformedEventError(f"a number has {len(content)} bytes")
    (number,) = (_DOUBLE if len(content) == _DOUBLE.size else _FLOAT).unpack(content)
    return float(number)


def _varint(message: bytes, offset: int) -> tuple[int, int]:
    """Return the number at an offset of a message, and the offset after it."""
    number = 0
    for shift, byte in enumerate(message[offset : offset + _MAX_VARINT_BYTES]):
        number |= (byte & 0x7F) << 7 * shift
        if byte < 0x80:
            return number & (1 << 64) - 1, offset + shift + 1
    raise MalformedEventError("a varint has no end")
