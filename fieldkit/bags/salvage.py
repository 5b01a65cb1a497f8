"""Messages of damaged bags: everything up to where a file is cut off or is nonsense, whatever its index says.

ROS's own tools save whole chunks; here the beginning of one that is cut off is read, too. A recorder of ROS 1 that is
killed leaves a chunk open whose length it had not yet written; where it is not compressed its records stand in the
file all the same, and are read.
"""

import bz2
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

from fieldkit.bags.formats import BagFormat


class DamagedError(Exception):
    """A file ends, or goes on with what is no bag, where more was to come; says where and why."""


@dataclass(frozen=True)
class BagConnection:
    """Where messages come from: a topic as one publisher of ROS 1, or all of ROS 2, have it.

    Attributes:
        topic: Its name.
        type: Type of its messages, `package/Name` in a bag of ROS 1 and `package/msg/Name` in one of ROS 2.
        definition: What the type is made of, empty where the bag does not say.
        digest: The definition's MD5 sum (ROS 1) or RIHS01 hash (ROS 2), empty where the bag does not say.
        caller: Name of the publisher (ROS 1).
        latching: Whether it latches (ROS 1).
        qos: What QoS was offered (ROS 2), as the bag has it.
    """

    topic: str
    type: str
    definition: str = ""
    digest: str = ""
    caller: str = ""
    latching: bool = False
    qos: str = ""


Saved = tuple[BagConnection, int, bytes]
"""Where a message comes from, when it was recorded, nanoseconds since 1970, and the message as the wire had it."""


def messages(form: BagFormat, file: Path) -> Iterator[Saved]:
    """Yield the messages of a data file in the order in which they stand there.

    Raises:
        DamagedError: What was yielded so far is all that can be read.
    """
    readers = {BagFormat.ROS1: _ros1, BagFormat.SQLITE: _sqlite, BagFormat.MCAP: _mcap}
    return readers[form](file)


# ROS 1: wiki.ros.org/Bags/Format/2.0.

_MAGIC: Final = b"#ROSBAG V2.0\n"
_LENGTH: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<II")
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_KNOWN: Final = range(2, 8)
_MOST_CHUNK_BYTES: Final = 1 << 30


def _ros1(file: Path) -> Iterator[Saved]:
    data = file.read_bytes()
    yield from _records(memoryview(data)[len(_MAGIC) :], {})


def _records(data: memoryview, sources: dict[int, BagConnection]) -> Iterator[Saved]:
    """Yield the messages of records, as they follow each other in a file or in a chunk."""
    at = 0
    while at < len(data):
        head, at = _sized(data, at)
        fields = _fields(head)
        (kind,) = fields.get("op", b"\0")
        if kind not in _KNOWN:
            raise DamagedError(f"a record of unknown kind {kind} {len(data) - at} bytes before the end")
        if kind == _CHUNK and bytes(data[at : at + 4]) == b"\0\0\0\0":
            at += 4  # still open when its recorder was killed: what follows is what is in it
            if fields.get("compression") != b"none":
                raise DamagedError("the recorder was killed within a chunk that is compressed")
            continue
        if kind == _CHUNK:
            # Of one that is cut off its beginning can be unpacked.
            yield from _records(
                memoryview(_unpacked(fields, data[at + _LENGTH.size :][: _length(data, at)])), sources
            )
        body, at = _sized(data, at)
        if kind == _CONNECTION:
            sources.setdefault(_number(fields, "conn"), _source(fields, body))
        elif kind == _MESSAGE:
            number = _number(fields, "conn")
            if number not in sources:
                raise DamagedError(f"a message of connection {number}, which the bag has not named")
            if len(fields.get("time", b"")) != _TIME.size:
                raise DamagedError("a message without time")
            seconds, nanoseconds = _TIME.unpack(fields["time"])
            yield sources[number], seconds * 10**9 + nanoseconds, bytes(body)


def _sized(data: memoryview, at: int) -> tuple[memoryview, int]:
    """Return the bytes at a place before which their number stands, and where they end."""
    end = at + _LENGTH.size + _length(data, at)
    if end > len(data):
        raise DamagedError(f"the file ends {end - len(data)} bytes before a record does")
    return data[at + _LENGTH.size : end], end


def _length(data: memoryview, at: int) -> int:
    if at + _LENGTH.size > len(data):
        raise DamagedError("the file ends within a record")
    (length,) = _LENGTH.unpack_from(data, at)
    return int(length)


def _fields(head: memoryview) -> dict[str, bytes]:
    fields, at = {}, 0
    while at < len(head):
        field, at = _sized(head, at)
        name, separator, value = bytes(field).partition(b"=")
        if not separator:
            raise DamagedError("a header without field names")
        fields[name.decode(errors="replace")] = value
    return fields


def _number(fields: dict[str, bytes], name: str) -> int:
    if len(fields.get(name, b"")) != _LENGTH.size:
        raise DamagedError(f"a record without {name}")
    (number,) = _LENGTH.unpack(fields[name])
    return int(number)


def _source(fields: dict[str, bytes], body: memoryview) -> BagConnection:
    told = {name: value.decode(errors="replace") for name, value in _fields(body).items()}
    return BagConnection(
        fields.get("topic", b"").decode(errors="replace"),
        told.get("type", ""),
        told.get("message_definition", ""),
        told.get("md5sum", ""),
        told.get("callerid", ""),
        told.get("latching", "0") == "1",
    )


def _unpacked(fields: dict[str, bytes], body: memoryview) -> bytes:
    """Return the records of a chunk, which says how many bytes they are."""
    size, how = _number(fields, "size"), fields.get("compression", b"")
    if size > _MOST_CHUNK_BYTES:
        raise DamagedError(f"a chunk of {size} bytes")
    try:
        if how == b"bz2":
            return bz2.BZ2Decompressor().decompress(bytes(body), size)
        if how == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(bytes(body), size))
    except (OSError, RuntimeError, EOFError) as error:
        raise DamagedError(f"a chunk that cannot be unpacked: {error}") from error
    if how != b"none":
        raise DamagedError(f"a chunk compressed by {how.decode(errors='replace')!r:.20}")
    return bytes(body)


# SQLite: rosbag2_storage_sqlite3's schema.


def _sqlite(file: Path) -> Iterator[Saved]:
    # What a recorder that was killed had not yet put into the file lies beside it (sqlite.org/wal.html). Only a copy
    # is opened, as to open it is to bring it in.
    with tempfile.TemporaryDirectory(prefix="fieldkit-") as folder:
        for suffix in ("", "-wal", "-journal"):
            beside = file.with_name(file.name + suffix)
            if beside.is_file():
                shutil.copyfile(beside, Path(folder, f"bag{suffix}"))
        try:
            with closing(sqlite3.connect(Path(folder, "bag"))) as database:
                yield from _rows(database)
        except (sqlite3.Error, ValueError, TypeError) as error:
            raise DamagedError(str(error)) from error


def _rows(database: sqlite3.Connection) -> Iterator[Saved]:
    sources = dict(_topics(database))
    last = 0
    for number, topic, at_ns, data in database.execute(
        "SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"
    ):
        if topic not in sources:
            raise DamagedError(f"message {number} is of topic {topic}, which the bag has not named")
        last = number
        yield sources[topic], int(at_ns), bytes(data)
    (most,) = database.execute("SELECT max(id) FROM messages").fetchone()
    if most is not None and most > last:
        raise DamagedError(f"of {most} messages only {last} can be read")


def _topics(database: sqlite3.Connection) -> Iterator[tuple[int, BagConnection]]:
    definitions = {}
    if _columns(database, "message_definitions"):
        definitions = dict(
            database.execute("SELECT topic_type, encoded_message_definition FROM message_definitions").fetchall()
        )
    has = _columns(database, "topics")
    asked = [one for one in ("id", "name", "type", "offered_qos_profiles", "type_description_hash") if one in has]
    for row in database.execute(f"SELECT {', '.join(asked)} FROM topics"):  # noqa: S608 (names of this module)
        told = dict(zip(asked, row, strict=True))
        yield (
            told["id"],
            BagConnection(
                str(told["name"]),
                str(told["type"]),
                str(definitions.get(told["type"], "")),
                str(told.get("type_description_hash", "")),
                qos=str(told.get("offered_qos_profiles", "")),
            ),
        )


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    return {name for _, name, *_ in database.execute(f"PRAGMA table_info({table})")}


# MCAP: mcap.dev/spec.


class _Exact:
    """Reads a file; who reads beyond its end gets an error, and not what is left."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, length: int) -> bytes:
        data = self._file.read(length)
        if len(data) < length:
            raise EOFError(f"the file ends {length - len(data)} bytes before a record does")
        return data


def _mcap(file: Path) -> Iterator[Saved]:
    schemas: dict[int, Schema] = {}
    sources: dict[int, BagConnection] = {}
    with file.open("rb") as opened:
        records = StreamReader(
            cast("IO[bytes]", _Exact(opened)), validate_crcs=True, record_size_limit=_MOST_CHUNK_BYTES
        ).records
        try:
            for record in records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    sources[record.id] = _of_channel(record, schemas.get(record.schema_id))
                elif isinstance(record, Message):
                    yield sources[record.channel_id], record.log_time, record.data
        except (McapError, KeyError, ValueError, RuntimeError, struct.error, EOFError) as error:
            raise DamagedError(f"{type(error).__name__}: {error}".strip(": ")) from error


def _of_channel(channel: Channel, schema: Schema | None) -> BagConnection:
    told = channel.metadata
    return BagConnection(
        channel.topic,
        schema.name if schema else "",
        schema.data.decode(errors="replace") if schema else "",
        told.get("topic_type_hash", ""),
        qos=told.get("offered_qos_profiles", ""),
    )
