"""Read the messages of damaged bags without their index, up to the point where a file is truncated or corrupt.

The tools of ROS recover only complete chunks. This module also reads the start of a truncated chunk. If a ROS 1
recorder is killed, the last chunk of its bag is open: it has no length. The records in an open chunk are read, too,
unless the chunk is compressed.
"""

import bz2
import os
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, cast

import lz4.frame
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader

from fieldkit.ros.bags.formats import BagFormat


class DamagedError(Exception):
    """A file is truncated or corrupt; the message contains the reason, and the position if it is known."""


@dataclass(frozen=True)
class BagConnection:
    """A connection of a bag: a topic of one publisher (ROS 1), or of all publishers (ROS 2).

    Attributes:
        topic: Name of the topic.
        type: Type of its messages, `package/Name` in a ROS 1 bag and `package/msg/Name` in a ROS 2 bag.
        definition: Definition of the type; empty if it is not in the bag.
        digest: MD5 sum (ROS 1) or RIHS01 hash (ROS 2) of the type; empty if it is not in the bag.
        caller: Name of the publisher (ROS 1).
        latching: Whether the topic is latched (ROS 1).
        qos: Offered QoS profiles (ROS 2), in the format of the bag.
    """

    topic: str
    type: str
    definition: str = ""
    digest: str = ""
    caller: str = ""
    latching: bool = False
    qos: str = ""


RecoveredMessage = tuple[BagConnection, int, bytes]
"""Connection of a message, time of its recording in nanoseconds since 1970, and the serialized message."""


def messages(bag_format: BagFormat, file: Path) -> Iterator[RecoveredMessage]:
    """Yield the messages of a data file in their order in the file.

    Raises:
        DamagedError: The file is damaged; all readable messages have been yielded.
    """
    readers = {BagFormat.ROS1: _ros1, BagFormat.SQLITE: _sqlite, BagFormat.MCAP: _mcap}
    return readers[bag_format](file)


# ROS 1: wiki.ros.org/Bags/Format/2.0.

_MAGIC: Final = b"#ROSBAG V2.0\n"
_LENGTH: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_KNOWN_KINDS: Final = range(2, 8)
"""Values of the field `op` in the header of a record."""
_MAX_CHUNK_BYTES: Final = 1 << 30
"""Maximum size of a decompressed chunk, which limits the memory if its header is corrupt."""


def _ros1(file: Path) -> Iterator[RecoveredMessage]:
    data = file.read_bytes()
    yield from _records(memoryview(data)[len(_MAGIC) :], {})


def _records(data: memoryview, connections: dict[int, BagConnection]) -> Iterator[RecoveredMessage]:
    """Yield the messages in a sequence of records, from a file or from a chunk."""
    offset = 0
    while offset < len(data):
        head, offset = _read_sized(data, offset)
        fields = _fields(head)
        (kind,) = fields.get("op", b"\0")
        if kind not in _KNOWN_KINDS:
            raise DamagedError(f"a record has the unknown kind {kind}, {len(data) - offset} bytes before the end")
        if kind == _CHUNK and bytes(data[offset : offset + _LENGTH.size]) == b"\0\0\0\0":
            offset += _LENGTH.size  # the chunk was open when its recorder was killed; its records follow
            if fields.get("compression") != b"none":
                raise DamagedError("the recorder was killed while it wrote a compressed chunk")
            continue
        if kind == _CHUNK:
            # The start of a truncated chunk can be decompressed.
            yield from _records(
                memoryview(_decompress(fields, data[offset + _LENGTH.size :][: _length(data, offset)])), connections
            )
        body, offset = _read_sized(data, offset)
        if kind == _CONNECTION:
            connections.setdefault(_number(fields, "conn"), _parse_connection(fields, body))
        elif kind == _MESSAGE:
            number = _number(fields, "conn")
            if number not in connections:
                raise DamagedError(f"a message belongs to connection {number}, which the bag does not define")
            if len(fields.get("time", b"")) != _TIME.size:
                raise DamagedError("a message has no time")
            seconds, nanoseconds = _TIME.unpack(fields["time"])
            yield connections[number], seconds * 10**9 + nanoseconds, bytes(body)


def _read_sized(data: memoryview, offset: int) -> tuple[memoryview, int]:
    """Return the content of a length-prefixed field at a position, and the position after the field."""
    end = offset + _LENGTH.size + _length(data, offset)
    if end > len(data):
        raise DamagedError(f"the file ends {end - len(data)} bytes before the end of a record")
    return data[offset + _LENGTH.size : end], end


def _length(data: memoryview, offset: int) -> int:
    if offset + _LENGTH.size > len(data):
        raise DamagedError("the file ends within a record")
    (length,) = _LENGTH.unpack_from(data, offset)
    return int(length)


def _fields(head: memoryview) -> dict[str, bytes]:
    fields, offset = {}, 0
    while offset < len(head):
        field, offset = _read_sized(head, offset)
        name, separator, value = bytes(field).partition(b"=")
        if not separator:
            raise DamagedError("a field of a header has no name")
        fields[name.decode(errors="replace")] = value
    return fields


def _number(fields: dict[str, bytes], name: str) -> int:
    if len(fields.get(name, b"")) != _LENGTH.size:
        raise DamagedError(f"a record has no valid field {name}")
    (number,) = _LENGTH.unpack(fields[name])
    return int(number)


def _parse_connection(fields: dict[str, bytes], body: memoryview) -> BagConnection:
    values = {name: value.decode(errors="replace") for name, value in _fields(body).items()}
    return BagConnection(
        fields.get("topic", b"").decode(errors="replace"),
        values.get("type", ""),
        values.get("message_definition", ""),
        values.get("md5sum", ""),
        values.get("callerid", ""),
        values.get("latching", "0") == "1",
    )


def _decompress(fields: dict[str, bytes], body: memoryview) -> bytes:
    """Return the decompressed records of a chunk, limited to the size in its header."""
    size, compression = _number(fields, "size"), fields.get("compression", b"")
    if size > _MAX_CHUNK_BYTES:
        raise DamagedError(f"a chunk of {size} bytes is larger than the limit of {_MAX_CHUNK_BYTES}")
    try:
        if compression == b"bz2":
            return bz2.BZ2Decompressor().decompress(bytes(body), size)
        if compression == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(bytes(body), size))
    except (OSError, RuntimeError, EOFError) as error:
        raise DamagedError(f"a chunk cannot be decompressed: {error}") from error
    if compression != b"none":
        raise DamagedError(f"a chunk has the unknown compression {compression.decode(errors='replace')!r:.20}")
    return bytes(body)


# SQLite: rosbag2_storage_sqlite3's schema.


def _sqlite(file: Path) -> Iterator[RecoveredMessage]:
    # The last writes of a killed recorder are in separate files (sqlite.org/wal.html). A copy is opened, because
    # opening the bag would merge these files into it.
    with tempfile.TemporaryDirectory(prefix="fieldkit-") as folder:
        for suffix in ("", "-wal", "-journal"):
            part = file.with_name(file.name + suffix)
            if part.is_file():
                shutil.copyfile(part, Path(folder, f"bag{suffix}"))
        try:
            with closing(sqlite3.connect(Path(folder, "bag"))) as database:
                yield from _rows(database)
        except (sqlite3.Error, ValueError, TypeError) as error:
            raise DamagedError(str(error)) from error


def _rows(database: sqlite3.Connection) -> Iterator[RecoveredMessage]:
    connections = dict(_topics(database))
    last_read_id = 0
    for message_id, topic, at_ns, data in database.execute(
        "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
    ):
        if topic not in connections:
            raise DamagedError(f"message {message_id} belongs to topic {topic}, which the bag does not define")
        last_read_id = message_id
        yield connections[topic], int(at_ns), bytes(data)
    (last_id,) = database.execute("SELECT max(id) FROM messages").fetchone()
    if last_id is not None and last_id > last_read_id:
        raise DamagedError(f"the last message that can be read has number {last_read_id} of {last_id}")


def _topics(database: sqlite3.Connection) -> Iterator[tuple[int, BagConnection]]:
    """Yield the id and the connection of each topic; older schemas lack some of the columns."""
    definitions = {}
    if _columns(database, "message_definitions"):
        definitions = dict(
            database.execute("SELECT topic_type, encoded_message_definition FROM message_definitions").fetchall()
        )
    available = _columns(database, "topics")
    if missing := {"id", "name", "type"} - available:
        raise DamagedError(f"the table topics has no {', '.join(sorted(missing))}")
    columns = [
        name for name in ("id", "name", "type", "offered_qos_profiles", "type_description_hash") if name in available
    ]
    for row in database.execute(f"SELECT {', '.join(columns)} FROM topics"):  # noqa: S608 (the names are constants of this module)
        values = dict(zip(columns, row, strict=True))
        yield (
            values["id"],
            BagConnection(
                str(values["name"]),
                str(values["type"]),
                str(definitions.get(values["type"], "")),
                str(values.get("type_description_hash", "")),
                qos=str(values.get("offered_qos_profiles", "")),
            ),
        )


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    return {name for _, name, *_ in database.execute(f"PRAGMA table_info({table})")}


# MCAP: mcap.dev/spec.


class _ExactReader:
    """Reads a file; a read beyond its end raises EOFError instead of returning fewer bytes."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._size_bytes = os.fstat(file.fileno()).st_size

    def read(self, length: int) -> bytes:
        if length > self._size_bytes:  # a corrupt length may be too large an argument for `file.read`
            raise EOFError(f"a record states a length of {length} bytes, but the file has {self._size_bytes}")
        data = self._file.read(length)
        if len(data) < length:
            raise EOFError(f"the file ends {length - len(data)} bytes before the end of a record")
        return data


def _mcap(file: Path) -> Iterator[RecoveredMessage]:
    schemas: dict[int, Schema] = {}
    connections: dict[int, BagConnection] = {}
    with file.open("rb") as stream:
        records = StreamReader(
            cast("IO[bytes]", _ExactReader(stream)), validate_crcs=True, record_size_limit=_MAX_CHUNK_BYTES
        ).records
        try:
            for record in records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    connections[record.id] = _channel_connection(record, schemas.get(record.schema_id))
                elif isinstance(record, Message):
                    yield connections[record.channel_id], record.log_time, record.data
        # OverflowError: a record inside a chunk states a length that is too large an argument for `read`.
        except (McapError, KeyError, ValueError, RuntimeError, OverflowError, struct.error, EOFError) as error:
            raise DamagedError(f"{type(error).__name__}: {error}".strip(": ")) from error


def _channel_connection(channel: Channel, schema: Schema | None) -> BagConnection:
    values = channel.metadata
    return BagConnection(
        channel.topic,
        schema.name if schema else "",
        schema.data.decode(errors="replace") if schema else "",
        values.get("topic_type_hash", ""),
        qos=values.get("offered_qos_profiles", ""),
    )
