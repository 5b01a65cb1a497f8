"""The framing that ROS 1 nodes speak (wiki.ros.org/ROS/TCPROS), here over one Unix socket per topic in the robot.

Every packet is its length in 4 bytes, little-endian, and that many bytes. The first each way is the connection
header, a sequence of fields `name=value`, each with its own length; each later one is one serialized message.
Standard library alone: Debian's own Python imports it too.
"""

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

FOLDER: Final = "/run/ros"
MAX_BYTES: Final = 64 << 20
CALLER: Final = "/sensors"

_LENGTH: Final = struct.Struct("<I")
LENGTH_BYTES: Final = _LENGTH.size


def socket_path(topic: str) -> Path:
    """Return the socket at which `topic` is published; `.` is in no topic's name."""
    return Path(FOLDER, topic.strip("/").replace("/", "."))


def topics() -> list[str]:
    """Return the topics that are published, sorted."""
    folder = Path(FOLDER)
    return sorted("/" + path.name.replace(".", "/") for path in folder.iterdir()) if folder.is_dir() else []


def pack(payload: bytes) -> bytes:
    """Return `payload` with its length."""
    return _LENGTH.pack(len(payload)) + payload


def request(caller: str, topic: str) -> bytes:
    """Return what a subscriber says first: that it wants `topic`, of whatever type."""
    return pack(pack_header({"callerid": caller, "topic": topic, "md5sum": "*", "type": "*"}))


def unpack_length(data: bytes) -> int:
    """Return the length that a packet begins with.

    Raises:
        ValueError: It is longer than any message here.
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
        ValueError: It is damaged.
    """
    packets = PacketSplitter()
    packets.feed(payload)
    fields = dict(field.decode().split("=", 1) for field in packets)
    if packets.pending:
        raise ValueError("a connection header ends in the middle of a field")
    return fields


class PacketSplitter:
    """Cuts a stream into packets; iterate after each `feed`."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Bytes of a packet that is not whole yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> None:
        """Take what arrived."""
        self._buffer += data

    def __iter__(self) -> Iterator[bytes]:
        """Return and forget each whole packet's payload.

        Raises:
            ValueError: As `unpack_length`.
        """
        while len(self._buffer) >= LENGTH_BYTES:
            end = LENGTH_BYTES + unpack_length(bytes(self._buffer[:LENGTH_BYTES]))
            if len(self._buffer) < end:
                return
            payload = bytes(self._buffer[LENGTH_BYTES:end])
            del self._buffer[:end]
            yield payload
