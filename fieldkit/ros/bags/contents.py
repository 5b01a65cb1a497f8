"""Inspect, check, repair and convert bags.

Each bag is opened by `worker`, in a separate process with limited memory, time and disk space.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError, EvidenceError, shell_command
from fieldkit.measure.evidence.sandbox import Json, ReaderError, SandboxedReader
from fieldkit.ros.bags.bag import allocated_bytes
from fieldkit.ros.bags.formats import LAST_RESORT, BagFiles, BagFormat, find

_WORKER: Final = SandboxedReader("fieldkit.ros.bags.worker")

_MAX_GROWTH: Final = 4
"""Maximum ratio of written to read bytes: the output may be uncompressed, and has an index."""


@dataclass(frozen=True)
class BagTopic:
    """One topic of a bag.

    Attributes:
        name: Its name.
        type: Message type, `package/msg/Name`.
        messages: Number of messages.
    """

    name: str
    type: str
    messages: int


@dataclass(frozen=True)
class BagContents:
    """The contents of a bag.

    Attributes:
        format: Its format.
        size_bytes: Size of its data files.
        topics: Its topics, sorted by name; empty if it was not closed or its index cannot be read.
        started_utc_ns: Time of the first message by the recorder's clock, nanoseconds since 1970; 0 without messages.
        duration_s: Time from the first message to the last, in seconds; 0 without messages.
        compression: Compression of a ROS 2 bag: `none` or `zstd`; always `none` for ROS 1.
        problems: Descriptions of its damage, one sentence each.
        recoverable_messages: Number of messages that can be recovered; None for a bag without problems.
    """

    format: BagFormat
    size_bytes: int
    topics: tuple[BagTopic, ...]
    started_utc_ns: int
    duration_s: float
    compression: str
    problems: tuple[str, ...]
    recoverable_messages: int | None

    @property
    def messages(self) -> int:
        """Number of messages according to its index; 0 if the index cannot be read."""
        return sum(topic.messages for topic in self.topics)


@dataclass(frozen=True)
class WriteResult:
    """The result of a repair or a conversion.

    Attributes:
        messages: Number of recovered messages; None for a conversion, which converts all messages.
        notes: Remarks on the new bag, one sentence each.
    """

    messages: int | None
    notes: tuple[str, ...]


def inspect(path: Path, *, read_all: bool = False) -> BagContents:
    """Return the contents of the bag at a path.

    Args:
        path: A file, or the folder of a ROS 2 bag.
        read_all: Whether to read and decode all messages, which takes time, to find damage outside the index.

    Raises:
        ConfigurationError: There is no bag, or it cannot be opened.
        EvidenceError: It is empty or begins with zeros, or reading it exceeds the limits of memory or time for its
            size.
    """
    bag = find(path)
    answer = _query_worker(bag, {"do": "inspect", "all": read_all})
    return BagContents(
        bag.format,
        bag.size_bytes,
        tuple(BagTopic(*topic) for topic in answer["topics"]),
        answer["started_utc_ns"],
        answer["duration_s"],
        answer["compression"],
        tuple(answer["problems"]),
        answer["saved"]["messages"] if "saved" in answer else None,
    )


def repair(path: Path, to: Path) -> WriteResult:
    """Write the readable messages of a damaged bag to a new bag of the same format; the damaged bag is not changed.

    Raises:
        ConfigurationError: For the same reasons as `inspect`, or because `to` exists already or cannot be written, or
            because its name does not fit the format.
        EvidenceError: For the same reasons as `inspect`, or because no message can be read.
    """
    bag = find(path)
    if (bag.format is BagFormat.ROS1) != (to.suffix == ".bag"):
        required_name = "NAME.bag" if bag.format is BagFormat.ROS1 else "a folder, whose name does not end in .bag"
        raise ConfigurationError(
            f"a repaired bag keeps its format, {bag.format}: the new one must be {required_name}", where=str(to)
        )

    def write(temporary_path: Path) -> WriteResult:
        answer = _query_worker(bag, {"do": "repair", "to": str(temporary_path)})
        if not answer["messages"]:
            what = f"no message can be recovered: {answer['why']}"
            raise EvidenceError(what, where=str(path), remedy=LAST_RESORT.get(bag.format, ""))
        return WriteResult(answer["messages"], (answer["why"],) if answer["why"] else ())

    return _write_atomically(to, write)


def convert(path: Path, to: Path, *, storage: BagFormat = BagFormat.MCAP, distribution: str = "") -> WriteResult:
    """Write a bag in another format: `NAME.bag` for ROS 1, otherwise a folder for ROS 2.

    Args:
        path: An undamaged bag.
        to: The new bag.
        storage: Storage format of a ROS 2 bag.
        distribution: ROS distribution of its message types; Noetic or Jazzy if empty.

    Raises:
        ConfigurationError: For the same reasons as `inspect`, or because `to` exists already or cannot be written, or
            because the distribution does not fit its format.
        EvidenceError: For the same reasons as `inspect`, or because the bag is damaged, or cannot be converted.
    """
    bag, is_ros1 = find(path), to.suffix == ".bag"
    distribution = distribution or ("noetic" if is_ros1 else "jazzy")
    if (distribution == "noetic") != is_ros1:
        raise ConfigurationError(
            f"{distribution} is ROS {'1' if distribution == 'noetic' else '2'}",
            where=str(to),
            remedy="name the new bag NAME.bag for ROS 1, or without .bag for ROS 2",
        )
    contents = inspect(path)
    if contents.problems:
        raise EvidenceError(
            f"the bag is damaged: {contents.problems[0]}",
            where=str(path),
            remedy=shell_command("fieldkit", "bag", "repair", path, "NEW"),
        )
    request = {"do": "convert", "storage": storage.value, "distribution": distribution}
    return _write_atomically(
        to,
        lambda temporary_path: WriteResult(
            None, tuple(_query_worker(bag, request | {"to": str(temporary_path)})["notes"])
        ),
    )


def _write_atomically(to: Path, write: Callable[[Path], WriteResult]) -> WriteResult:
    """Write a bag to a temporary folder beside its destination, and rename it when it is complete."""
    if to.exists() or to.is_symlink():
        raise ConfigurationError("it exists already", where=str(to), remedy="choose another name")
    try:
        with tempfile.TemporaryDirectory(prefix=f".{to.name}-", dir=to.parent) as folder:
            temporary_path = Path(folder, to.name)
            result = write(temporary_path.absolute())
            temporary_path.rename(to)
    except OSError as error:
        raise ConfigurationError(
            f"cannot write there: {error.strerror or error}",
            where=str(to),
            remedy="choose a path in an existing folder with write permission",
        ) from error
    return result


def _query_worker(bag: BagFiles, request: Json) -> Json:
    size_bytes = _MAX_GROWTH * sum(allocated_bytes(file) for file in bag.files)
    try:
        return _WORKER.query({"path": str(bag.path.absolute()), **request}, size_bytes)
    except ReaderError as error:
        raise EvidenceError(f"the bag cannot be read: {error}", where=str(bag.path)) from error
