"""The `rosbag` command of an emulated robot without ROS: `record` and `info`, which behave as in ROS (rosbag 1.15).

Like the original, `record` is a wrapper around a recorder process. The wrapper rejects wrong options with exit code
2. Otherwise it forwards SIGINT and SIGTERM to the recorder, and always returns 0. If only the wrapper is killed with
SIGKILL, the recorder continues. Options of the original that no trial uses are rejected as unknown.
"""

import errno
import optparse
import os
import signal
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import decompressors
from rosbags.typesys.msg import denormalize_msgtype

from sim_backends.emulated.ros.rosbag_record import Options, RecorderError, Rosbag1Recorder

# Time that the original waits for its recorder after it has forwarded a signal: after KeyboardInterrupt,
# subprocess.Popen.wait in Python 3 waits a quarter of a second for the child.
_AFTER_SIGNAL_S: Final = 0.25

_SECONDS: Final = {"s": 1.0, "m": 60.0, "h": 3600.0}


def record(argv: Sequence[str]) -> int:
    """Record a bag."""
    options = _record_options(argv)
    forwarded_signals = {signal.SIGINT, signal.SIGTERM}
    signal.pthread_sigmask(signal.SIG_BLOCK, {*forwarded_signals, signal.SIGCHLD})
    sys.stdout.flush()
    recorder = os.fork()
    if recorder == 0:
        os._exit(_record_in_child(options))
    number = signal.sigwait({*forwarded_signals, signal.SIGCHLD})
    if number in forwarded_signals:
        os.kill(recorder, number)
        signal.sigtimedwait({signal.SIGCHLD}, _AFTER_SIGNAL_S)
    return 0


def _record_in_child(values: optparse.Values) -> int:
    """Record a bag in the recorder process; return its exit code."""
    try:
        Rosbag1Recorder(
            Options(
                topics=tuple(sorted(set(values.topics))),
                all_topics=values.all,
                prefix=values.prefix,
                name=values.name,
                duration_s=_seconds(values.duration),
                limit=values.num,
                chunk_bytes=values.chunksize * 1024,
            )
        ).run()
    except RecorderError as error:
        sys.stderr.write(error.line)
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def _record_options(argv: Sequence[str]) -> optparse.Values:
    parser = optparse.OptionParser(
        usage="rosbag record TOPIC1 [TOPIC2 TOPIC3 ...]",
        description="Record a bag file with the contents of specified topics.",
        prog="rosbag",
    )
    parser.add_option("-a", "--all", default=False, action="store_true", help="record every topic")
    parser.add_option(
        "-q", "--quiet", default=False, action="store_true", help="accepted without effect, as in the original"
    )
    parser.add_option("-o", "--output-prefix", dest="prefix", help="name the bag PREFIX_DATE.bag")
    parser.add_option("-O", "--output-name", dest="name", help="name the bag NAME.bag")
    parser.add_option("--duration", help="stop after this many seconds, or minutes (m) or hours (h)")
    parser.add_option("--chunksize", default=768, type="int", help="size of a chunk in KB", metavar="SIZE")
    parser.add_option("-l", "--limit", dest="num", default=0, type="int", help="stop each topic after NUM messages")
    values, topics = parser.parse_args(list(argv))
    if not topics and not values.all:
        parser.error("You must specify a topic name or else use the '-a' option.")
    if values.prefix is not None and values.name is not None:
        parser.error("Can't set both prefix and name.")
    values.topics = topics
    return values


def _seconds(text: str | None) -> float | None:
    """Return a duration in seconds, or None for None.

    Raises:
        RecorderError: The text is not a duration; the message is that of the original's recorder.
    """
    if text is None:
        return None
    number = text.rstrip("abcdefghijklmnopqrstuvwxyz")
    unit = text.removeprefix(number) or "s"
    try:
        value = float(number)
    except ValueError:
        raise RecorderError("Error reading options: Duration must start with a floating point number.") from None
    if unit not in _SECONDS:
        raise RecorderError("Error reading options: Duration unit must be s, m, or h")
    return value * _SECONDS[unit]


def _info(argv: Sequence[str]) -> int:
    """Summarize bags."""
    parser = optparse.OptionParser(
        usage="rosbag info [options] BAGFILE1 [BAGFILE2 BAGFILE3 ...]",
        description="Summarize the contents of one or more bag files.",
        prog="rosbag",
    )
    _, bags = parser.parse_args(list(argv))
    if not bags:
        parser.error("You must specify at least 1 bag file.")
    return info(bags)


def info(bags: Sequence[str]) -> int:
    """Print a summary of each bag; return the exit code."""
    for number, name in enumerate(bags):
        try:
            reader = _open(name)
        except (FileNotFoundError, ReaderError) as error:
            sys.stderr.write(f"{_error_text(name, error)}\n")
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


def _error_text(name: str, error: Exception) -> str:
    if "not indexed" in str(error):
        return f"ERROR bag unindexed: {name}.  Run rosbag reindex."
    if "magic is invalid" in str(error):
        return f"ERROR reading {name}: This does not appear to be a bag file"
    return f"ERROR reading {name}: {error}"


def _summary(reader: Reader, name: str) -> str:
    """Return the summary of a bag in the layout of ROS's `rosbag info`."""
    blocks: dict[str, list[str]] = {"path": [name], "version": ["2.0"]}
    if reader.message_count:
        # rosbags adds 1 ns to the last stamp, so that an interval of stamps includes that message.
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
    digests = {denormalize_msgtype(connection.msgtype): connection.digest for connection in reader.connections}
    width = max(map(len, digests))
    return [f"{name:<{width}} [{digest}]" for name, digest in sorted(digests.items())]


def _topics(reader: Reader) -> list[str]:
    counts: Counter[str] = Counter()
    types: defaultdict[str, set[str]] = defaultdict(set)
    for connection in reader.connections:
        counts[connection.topic] += connection.msgcount
        types[connection.topic].add(denormalize_msgtype(connection.msgtype))
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
    minutes, remainder_s = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    clock = f"{hours}hr {minutes}:{remainder_s:02d}s" if hours else f"{minutes}:{remainder_s:02d}s"
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


_COMMANDS: Final[dict[str, Callable[[Sequence[str]], int]]] = {"info": _info, "record": record}


def main() -> int:
    """Run the command line; like the original, print an error for an unknown command and return 0."""
    command = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if command in _COMMANDS:
        return _COMMANDS[command](sys.argv[2:])
    commands = "".join(f"   {name}  \t{run.__doc__}\n" for name, run in _COMMANDS.items())
    if command in {"-h", "--help", "help"}:
        sys.stdout.write(
            "This is the rosbag of fieldkit, not the rosbag of ROS (emulated: ros: builtin).\n"
            f"Usage: rosbag <subcommand> [options] [args]\n\nAvailable subcommands:\n{commands}\n"
        )
    else:
        sys.stderr.write(f"Unknown command: {command!r}\nAvailable subcommands:\n{commands}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
