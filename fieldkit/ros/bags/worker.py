"""The process that inspects, repairs and converts bags with third-party libraries.

`fieldkit.ros.bags.contents` runs it in a sandbox, because files from a robot may be malicious
(`fieldkit.measure.evidence.sandbox`).
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

from fieldkit.core.units import format_count
from fieldkit.measure.evidence import sandbox_process
from fieldkit.measure.evidence.sandbox import Json
from fieldkit.ros.bags import bag_paths, salvage
from fieldkit.ros.bags.formats import BagFiles, BagFormat, find
from fieldkit.ros.bags.salvage import BagConnection, DamagedError

_MAX_PROBLEMS: Final = 20
_METADATA_VERSION: Final = 9
"""Version of metadata.yaml in ROS 2 Jazzy and later. Older distributions can read it, except for the QoS profiles."""

_UNKNOWN_HASH: Final = "RIHS01_" + 64 * "0"
"""Hash of a type whose definition is neither in the bag nor known to fieldkit."""


def answer(request: Json) -> Json:
    """Execute a request of `fieldkit.ros.bags.contents`.

    Raises:
        Exception: The bag cannot be read; the libraries raise exceptions of any type for invalid bytes.
    """
    path = Path(request["path"])
    if request["do"] == "inspect":
        return inspect(find(path), read_all=request["all"])
    if request["do"] == "repair":
        return repair(find(path), Path(request["to"]))
    return convert_bag(find(path), Path(request["to"]), request["storage"], request["distribution"])


# Inspection.


def inspect(bag: BagFiles, *, read_all: bool) -> Json:
    """Return the contents of a bag from its index, and its problems.

    With `read_all`, all messages of a closed bag are read, and those of known types are decoded.
    """
    result: Json = {"topics": [], "started_utc_ns": 0, "duration_s": 0.0, "compression": "none"}
    problems = list(_unclosed_problems(bag))
    if not problems:
        try:
            with _reader(bag) as reader:
                result |= _contents(reader)
            if read_all:
                problems += _problems(bag)
        except Exception as error:  # noqa: BLE001 (as in `answer`; the error is a part of the result)
            problems.append(_error_text(error))
    if problems:
        recoverable = _count_recoverable(bag)
        result |= {"saved": recoverable}
        if not bag.closed and recoverable["why"]:  # the files of an unclosed bag were not read above
            problems.append(recoverable["why"])
    return result | {"problems": problems[:_MAX_PROBLEMS]}


def _unclosed_problems(bag: BagFiles) -> Iterator[str]:
    if not bag.closed:
        yield "there is no metadata.yaml: the recorder was killed before it closed the bag, or this file was lost"


def _reader(bag: BagFiles) -> rosbag1.Reader | rosbag2.Reader:
    if bag.format is BagFormat.ROS1:
        return rosbag1.Reader(bag.path)
    return rosbag2.Reader(bag.path)


def _contents(reader: rosbag1.Reader | rosbag2.Reader) -> Json:
    message_counts: Counter[tuple[str, str]] = Counter()
    if isinstance(reader, rosbag1.Reader):
        for connection in reader.connections:
            message_counts[connection.topic, connection.msgtype] += sum(
                info.connection_counts.get(connection.id, 0) for info in reader.chunk_infos
            )
        compression = "none"
    else:
        for connection in reader.connections:
            message_counts[connection.topic, connection.msgtype] += connection.msgcount
        compression = reader.compression_format or "none"
    return {
        "topics": [[topic, kind, count] for (topic, kind), count in sorted(message_counts.items())],
        "started_utc_ns": reader.start_time if reader.message_count else 0,
        # The duration of rosbags ends one nanosecond after the last message.
        "duration_s": max(reader.duration - 1, 0) / 1e9,
        "compression": compression,
    }


def _problems(bag: BagFiles) -> Iterator[str]:
    """Read all messages, and yield the problems."""
    read_counts: Counter[str] = Counter()
    errors_by_type: dict[str, str] = {}
    with _any_reader(bag) as reader:
        start_ns, end_ns = reader.start_time, reader.end_time
        outside_count = 0
        for connection, at_ns, data in reader.messages():
            read_counts[connection.topic] += 1
            outside_count += not start_ns <= at_ns <= end_ns
            if connection.msgtype in errors_by_type or connection.msgtype not in reader.typestore.fielddefs:
                continue
            try:
                reader.deserialize(data, connection.msgtype)
            except Exception as error:  # noqa: BLE001 (as in `answer`)
                message_name = f"message {read_counts[connection.topic]} of {connection.topic}"
                errors_by_type[connection.msgtype] = (
                    f"{message_name} is not a valid {connection.msgtype}: {_error_text(error)}"
                )
        if reader.message_count != sum(read_counts.values()):
            index_text = f"its index counts {format_count(reader.message_count, 'message')}"
            yield f"{index_text}, but it contains {sum(read_counts.values())}"
        if outside_count:
            yield f"{format_count(outside_count, 'message')} outside the time range of its index"
    yield from errors_by_type.values()


def _any_reader(bag: BagFiles) -> AnyReader:
    # Before ROS 2 Iron, SQLite bags contain no type definitions.
    return AnyReader([bag.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _count_recoverable(bag: BagFiles) -> Json:
    """Return the number of messages that can be recovered, and the damage at which reading stops, if any."""
    count, reason = 0, ""
    try:
        for file in bag.files:
            for _ in salvage.messages(bag.format, file):
                count += 1
    except DamagedError as error:
        reason = str(error)
    return {"messages": count, "why": reason}


# Repair.


def repair(bag: BagFiles, to: Path) -> Json:
    """Write the readable messages of a bag to a new bag of the same format; return their number."""
    types = get_typestore(Stores.ROS1_NOETIC if bag.format is BagFormat.ROS1 else Stores.ROS2_JAZZY)
    count, reason = 0, ""
    with _writer(bag.format, to) as writer:
        connections: dict[BagConnection, Connection] = {}
        try:
            for file in bag.files:
                for source, at_ns, data in salvage.messages(bag.format, file):
                    if source not in connections:
                        connections[source] = _add_connection(writer, source, types)
                    writer.write(connections[source], at_ns, data)
                    count += 1
        except DamagedError as error:
            reason = str(error)
    return {"messages": count, "why": reason}


def _writer(bag_format: BagFormat, to: Path) -> rosbag1.Writer | rosbag2.Writer:
    if bag_format is BagFormat.ROS1:
        return rosbag1.Writer(to)
    plugin = rosbag2.StoragePlugin.MCAP if bag_format is BagFormat.MCAP else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(to, version=_METADATA_VERSION, storage_plugin=plugin)


def _add_connection(writer: rosbag1.Writer | rosbag2.Writer, source: BagConnection, types: Typestore) -> Connection:
    if isinstance(writer, rosbag1.Writer):
        return writer.add_connection(
            source.topic,
            normalize_msgtype(source.type),
            msgdef=source.definition,
            md5sum=source.digest,
            callerid=source.caller or None,
            latching=int(source.latching),
        )
    is_known = source.type in types.fielddefs
    definition = source.definition or (types.generate_msgdef(source.type, ros_version=2)[0] if is_known else "")
    return writer.add_connection(
        source.topic,
        source.type,
        msgdef=definition,
        rihs01=source.digest or (types.hash_rihs01(source.type) if is_known else _UNKNOWN_HASH),
        offered_qos_profiles=parse_qos(source.qos) if source.qos else (),
    )


# Conversion.


def message_types(distribution: str) -> Typestore:
    """Return the message types of a ROS distribution."""
    return get_typestore(Stores(f"ros{1 if distribution == 'noetic' else 2}_{distribution}"))


def convert_bag(bag: BagFiles, to: Path, storage: str, distribution: str) -> Json:
    """Write a bag in another format with the message types of a distribution; return the output lines of rosbags."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output):  # standard output is reserved for the answers
        convert(
            srcs=[bag.path],
            dst=to,
            dst_storage=storage,
            dst_version=_METADATA_VERSION,
            compress=None,
            compress_mode="file",
            default_typestore=get_typestore(Stores.ROS2_HUMBLE),
            typestore=message_types(distribution),
            exclude_topics=(),
            include_topics=(),
            exclude_msgtypes=(),
            include_msgtypes=(),
        )
    return {"notes": output.getvalue().splitlines()[:_MAX_PROBLEMS]}


def _error_text(error: Exception) -> str:
    text = " ".join(str(error)[:1000].split())
    text = re.sub(r"\('([^']*)',\)", r"\1", text)  # rosbags embeds the arguments of another error in its message
    return f"{text or type(error).__name__}"[:300]


if __name__ == "__main__":
    bag_paths.allow_any()
    sandbox_process.serve(answer)
