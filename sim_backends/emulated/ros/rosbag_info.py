"""`rosbag info`: the summary that ROS's own command prints, line for line."""

import errno
import os
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import decompressors
from rosbags.typesys.msg import denormalize_msgtype


def info(bags: Sequence[str]) -> int:
    """Print a summary of each bag; return the exit code."""
    for number, name in enumerate(bags):
        try:
            reader = _open(name)
        except (FileNotFoundError, ReaderError) as error:
            sys.stderr.write(f"{_complaint(name, error)}\n")
            return 1
        sys.stdout.write(("---\n" if number else "") + _summary(reader, name))
        reader.close()
    return 0


def _open(name: str) -> Reader:
    if not Path(name).exists():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), name)
    reader = Reader(name)
    reader.open()
    return reader


def _complaint(name: str, error: Exception) -> str:
    if "not indexed" in str(error):
        return f"ERROR bag unindexed: {name}.  Run rosbag reindex."
    if "magic is invalid" in str(error):
        return f"ERROR reading {name}: This does not appear to be a bag file"
    return f"ERROR reading {name}: {error}"


def _summary(reader: Reader, name: str) -> str:
    blocks: dict[str, list[str]] = {"path": [name], "version": ["2.0"]}
    if reader.message_count:
        # rosbags adds 1 ns to the last stamp, so that an interval of stamps includes it.
        first_ns, last_ns = reader.start_time, reader.end_time - 1
        blocks["duration"] = [_duration((last_ns - first_ns) / 1e9)]
        blocks["start"], blocks["end"] = [_stamp(first_ns)], [_stamp(last_ns)]
    blocks["size"] = [_size(Path(name).stat().st_size)]
    if reader.message_count:
        blocks["messages"] = [str(reader.message_count)]
        blocks["compression"] = [_compression(reader)]
        blocks["types"], blocks["topics"] = _types(reader), _topics(reader)
    width = max(map(len, blocks)) + 2
    lines = []
    for label, values in blocks.items():
        lines.append(f"{label + ':':<{width}}{values[0]}")
        lines += [" " * width + value for value in values[1:]]
    return "\n".join(lines) + "\n"


def _types(reader: Reader) -> list[str]:
    digests = {denormalize_msgtype(one.msgtype): one.digest for one in reader.connections}
    width = max(map(len, digests))
    return [f"{name:<{width}} [{digest}]" for name, digest in sorted(digests.items())]


def _topics(reader: Reader) -> list[str]:
    counts: Counter[str] = Counter()
    types: defaultdict[str, set[str]] = defaultdict(set)
    for one in reader.connections:
        counts[one.topic] += one.msgcount
        types[one.topic].add(denormalize_msgtype(one.msgtype))
    topic_width = max(map(len, counts))
    count_width = max(len(str(count)) for count in counts.values())
    type_width = max(len(name) for names in types.values() for name in names)
    lines = []
    for topic in sorted(counts):
        plural = "msgs" if counts[topic] > 1 else "msg "
        names = ", ".join(f"{name:<{type_width}}" for name in sorted(types[topic]))
        lines.append(f"{topic:<{topic_width}}   {counts[topic]:>{count_width}} {plural}    : {names}")
    return lines


def _compression(reader: Reader) -> str:
    names = {function: name for name, function in decompressors.items()}
    counts = Counter(names[chunk.decompressor] for chunk in reader.chunks.values())
    return ", ".join(f"{name} [{count}/{counts.total()} chunks]" for name, count in counts.most_common())


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f}s"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    clock = f"{hours}hr {minutes}:{rest:02d}s" if hours else f"{minutes}:{rest:02d}s"
    return f"{clock} ({int(seconds)}s)"


def _stamp(ns: int) -> str:
    seconds, hundredths = divmod(round(ns / 1e7), 100)
    local = datetime.fromtimestamp(seconds, tz=UTC).astimezone()
    return f"{local:%b %d %Y %H:%M:%S}.{hundredths:02d} ({ns / 1e9:.2f})"


def _size(size_bytes: int) -> str:
    size = float(size_bytes)
    for unit in ("B", "KB", "MB", "GB"):
        if size < 1024 or unit == "GB":
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1024
    raise AssertionError
