"""What opens bags with libraries: looks into them, saves what can be saved, converts. Run confined, by `bags`.

Whatever a robot brings may be made to harm (`fieldkit.measure.evidence.confined`).
"""

import contextlib
import io
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rosbags import rosbag1, rosbag2
from rosbags.convert.converter import convert
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from fieldkit.bags import salvage
from fieldkit.bags.formats import BagFiles, BagFormat, find
from fieldkit.bags.salvage import BagConnection, DamagedError
from fieldkit.measure.evidence import bag_paths, confined
from fieldkit.measure.evidence.confined import Json

_MOST_PROBLEMS: Final = 20
_METADATA_VERSION: Final = 9
"""Of ROS 2 Jazzy and later; older ones read it but for the QoS."""

_UNKNOWN_HASH: Final = "RIHS01_" + 64 * "0"
"""In place of the hash of a type whose definition a bag does not hold, and fieldkit does not know."""


def answer(question: Json) -> Json:
    """Answer what `bags` asks.

    Raises:
        Exception: The bag cannot be read at all; any, as the libraries raise for bytes that are no bag.
    """
    path = Path(question["path"])
    if question["do"] == "inspect":
        return inspect(find(path), read_all=question["all"])
    if question["do"] == "repair":
        return repair(find(path), Path(question["to"]))
    return converted(find(path), Path(question["to"]), question["storage"], question["distribution"])


# Looking into it.


def inspect(bag: BagFiles, *, read_all: bool) -> Json:
    """Return what a bag holds by its index, and its problems; with `read_all` every message is read and decoded."""
    found: Json = {"topics": [], "started_utc_ns": 0, "duration_s": 0.0, "compression": "none"}
    problems = list(_unclosed(bag))
    if not problems:
        try:
            with _reader(bag) as reader:
                found |= _contents(reader)
            if read_all:
                problems += _problems(bag)
        except Exception as error:  # noqa: BLE001 (as `answer`; what is wrong is what is asked for)
            problems.append(_told(error))
    if problems:
        saved = _savable(bag)
        found |= {"saved": saved}
        if not bag.closed and saved["why"]:  # nothing else has looked into the files
            problems.append(saved["why"])
    return found | {"problems": problems[:_MOST_PROBLEMS]}


def _unclosed(bag: BagFiles) -> Iterator[str]:
    if not bag.closed:
        yield "there is no metadata.yaml: its recorder was ended before it could close it, or it was copied alone"


def _reader(bag: BagFiles) -> rosbag1.Reader | rosbag2.Reader:
    if bag.format is BagFormat.ROS1:
        return rosbag1.Reader(bag.path)
    return rosbag2.Reader(bag.path)


def _contents(reader: rosbag1.Reader | rosbag2.Reader) -> Json:
    by_topic: Counter[tuple[str, str]] = Counter()
    if isinstance(reader, rosbag1.Reader):
        for one in reader.connections:
            by_topic[one.topic, one.msgtype] += sum(
                info.connection_counts.get(one.id, 0) for info in reader.chunk_infos
            )
        compression = "none"
    else:
        for one in reader.connections:
            by_topic[one.topic, one.msgtype] += one.msgcount
        compression = reader.compression_format or "none"
    return {
        "topics": [[topic, kind, count] for (topic, kind), count in sorted(by_topic.items())],
        "started_utc_ns": reader.start_time if reader.message_count else 0,
        # rosbags counts to one nanosecond after the last message.
        "duration_s": max(reader.duration - 1, 0) / 1e9,
        "compression": compression,
    }


def _problems(bag: BagFiles) -> Iterator[str]:
    """Read every message, and yield what is wrong."""
    read: Counter[str] = Counter()
    undecoded: dict[str, str] = {}
    with _any_reader(bag) as reader:
        begin_ns, end_ns = reader.start_time, reader.end_time
        outside = 0
        for connection, at_ns, data in reader.messages():
            read[connection.topic] += 1
            outside += not begin_ns <= at_ns <= end_ns
            if connection.msgtype in undecoded or connection.msgtype not in reader.typestore.fielddefs:
                continue
            try:
                reader.deserialize(data, connection.msgtype)
            except Exception as error:  # noqa: BLE001 (as `answer`)
                which = f"message {read[connection.topic]} of {connection.topic}"
                undecoded[connection.msgtype] = f"{which} is no {connection.msgtype}: {_told(error)}"
        if reader.message_count != sum(read.values()):
            yield f"its index counts {reader.message_count} messages, {sum(read.values())} are there"
        if outside:
            yield f"{outside} messages lie outside the time that its index tells"
    yield from undecoded.values()


def _any_reader(bag: BagFiles) -> AnyReader:
    # A bag in SQLite does not say what its types are made of before ROS 2 Iron.
    return AnyReader([bag.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _savable(bag: BagFiles) -> Json:
    """Return how many messages can be saved, and why no more."""
    count, why = 0, ""
    try:
        for file in bag.files:
            for _ in salvage.messages(bag.format, file):
                count += 1
    except DamagedError as error:
        why = str(error)
    return {"messages": count, "why": why}


# Saving it.


def repair(bag: BagFiles, to: Path) -> Json:
    """Write what can be read of a bag into a new one of the same format; return how much that is."""
    types = get_typestore(Stores.ROS1_NOETIC if bag.format is BagFormat.ROS1 else Stores.ROS2_JAZZY)
    count, why = 0, ""
    with _writer(bag.format, to) as writer:
        connections: dict[BagConnection, Connection] = {}
        try:
            for file in bag.files:
                for source, at_ns, data in salvage.messages(bag.format, file):
                    if source not in connections:
                        connections[source] = _connection(writer, source, types)
                    writer.write(connections[source], at_ns, data)
                    count += 1
        except DamagedError as error:
            why = str(error)
    return {"messages": count, "why": why}


def _writer(form: BagFormat, to: Path) -> rosbag1.Writer | rosbag2.Writer:
    if form is BagFormat.ROS1:
        return rosbag1.Writer(to)
    plugin = rosbag2.StoragePlugin.MCAP if form is BagFormat.MCAP else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(to, version=_METADATA_VERSION, storage_plugin=plugin)


def _connection(writer: rosbag1.Writer | rosbag2.Writer, source: BagConnection, types: Typestore) -> Connection:
    if isinstance(writer, rosbag1.Writer):
        return writer.add_connection(
            source.topic,
            normalize_msgtype(source.type),
            msgdef=source.definition,
            md5sum=source.digest,
            callerid=source.caller or None,
            latching=int(source.latching),
        )
    known = source.type in types.fielddefs
    definition = source.definition or (types.generate_msgdef(source.type, ros_version=2)[0] if known else "")
    return writer.add_connection(
        source.topic,
        source.type,
        msgdef=definition,
        rihs01=source.digest or (types.hash_rihs01(source.type) if known else _UNKNOWN_HASH),
        offered_qos_profiles=parse_qos(source.qos) if source.qos else (),
    )


# Converting it.


def types_of(distribution: str) -> Typestore:
    """Return the message types of a distribution of ROS."""
    return get_typestore(Stores(f"ros{1 if distribution == 'noetic' else 2}_{distribution}"))


def converted(bag: BagFiles, to: Path, storage: str, distribution: str) -> Json:
    """Write a bag in another format, its types as a distribution has them; return what there is to say of it."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):  # which is where answers go
        convert(
            srcs=[bag.path],
            dst=to,
            dst_storage=storage,
            dst_version=_METADATA_VERSION,
            compress=None,
            compress_mode="file",
            default_typestore=get_typestore(Stores.ROS2_HUMBLE),
            typestore=types_of(distribution),
            exclude_topics=(),
            include_topics=(),
            exclude_msgtypes=(),
            include_msgtypes=(),
        )
    return {"notes": said.getvalue().splitlines()[:_MOST_PROBLEMS]}


def _told(error: Exception) -> str:
    text = " ".join(str(error)[:1000].split())
    text = re.sub(r"\('([^']*)',\)", r"\1", text)  # rosbags puts the arguments of another error into its own
    return f"{text or type(error).__name__}"[:300]


if __name__ == "__main__":
    bag_paths.allow_any()
    confined.serve(answer)
