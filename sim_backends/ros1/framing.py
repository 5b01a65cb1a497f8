"""Framing of TCPROS, the protocol between ROS 1 nodes.

Source: wiki.ros.org/ROS/TCPROS. Every packet consists of its length in 4 bytes, little-endian, and its payload. The
first packet in each direction is the connection header, a sequence of fields `name=value`, each with its length. Each
later packet is a serialized message. Only the standard library is imported, because Debian's Python imports this
module too.
"""

import struct
from collections.abc import Iterator, Mapping
from typing import Final

MAX_BYTES: Final = 64 << 20
"""Maximum length of a payload."""

_LENGTH: Final = struct.Struct("<I")
LENGTH_BYTES: Final = _LENGTH.size


def pack(payload: bytes) -> bytes:
    """Return `payload` with its length in front."""
    return _LENGTH.pack(len(payload)) + payload


def unpack_length(data: bytes) -> int:
    """Return the length of a packet's payload from the first 4 bytes of the packet.

    Raises:
        ValueError: The length exceeds `MAX_BYTES`.
    """
    (length,) = _LENGTH.unpack(data)
    if length > MAX_BYTES:
        raise ValueError(f"a packet of {length} bytes is longer than {MAX_BYTES}")
    return int(length)


def pack_header(fields: Mapping[str, str]) -> bytes:
    """Return the payload of a connection header."""
    return b"".join(pack(f"{name}={value}".encode()) for name, value in fields.items())


def unpack_header(payload: bytes) -> dict[str, str]:
    """Return the fields of a connection header.

    Raises:
        ValueError: The header is damaged.
    """
    packets = PacketSplitter()
    packets.feed(payload)
    fields = dict(field.decode().split("=", 1) for field in packets)
    if packets.pending:
        raise ValueError("a connection header ends within a field")
    return fields


class PacketSplitter:
    """Splits a stream into packets; iterate after each `feed`."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Number of bytes of an incomplete packet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add received data."""
        self._buffer += data

    def __iter__(self) -> Iterator[bytes]:
        """Yield and remove the payload of each complete packet.

        Raises:
            ValueError: The length of a packet exceeds `MAX_BYTES`.
        """
        while len(self._buffer) >= LENGTH_BYTES:
            end = LENGTH_BYTES + unpack_length(bytes(self._buffer[:LENGTH_BYTES]))
            if len(self._buffer) < end:
                return
            payload = bytes(self._buffer[LENGTH_BYTES:end])
            del self._buffer[:end]
            yield payload
