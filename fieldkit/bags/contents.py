"""What a bag holds, and whether it is whole; saving what can be read of a damaged one; conversion.

Every bag is opened by `worker`, in a process of its own whose memory, time and disk are bounded.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.bags.formats import LAST_RESORT, BagFiles, BagFormat, find
from fieldkit.core.errors import ConfigurationError, EvidenceError, typed
from fieldkit.measure.evidence.bag import given_bytes
from fieldkit.measure.evidence.confined import Confined, ConfinedAnswerError, Json

_WORKER: Final = Confined("fieldkit.bags.worker")

_GROWS: Final = 4
"""What is written may be so many times as large as what is read: unpacked, and with an index."""


@dataclass(frozen=True)
class BagTopic:
    """One topic of a bag.

    Attributes:
        name: Its name.
        type: Message type, `package/msg/Name`.
        messages: How many there are.
    """

    name: str
    type: str
    messages: int


@dataclass(frozen=True)
class BagContents:
    """What a bag holds.

    Attributes:
        format: What it is made of.
        size_bytes: Size of its data files.
        topics: Its topics, sorted by name; none where its index cannot be read.
        started_utc_ns: Time of the first message by the recorder's clock, nanoseconds since 1970.
        duration_s: Time from the first message to the last, in seconds.
        compression: Of ROS 2's bags, `none` or `zstd`.
        problems: Why it is not whole, a sentence each.
        savable: How many messages can be read in spite of them; None for a bag without problems.
    """

    format: BagFormat
    size_bytes: int
    topics: tuple[BagTopic, ...]
    started_utc_ns: int
    duration_s: float
    compression: str
    problems: tuple[str, ...]
    savable: int | None

    @property
    def messages(self) -> int:
        """How many messages there are by its index."""
        return sum(topic.messages for topic in self.topics)


@dataclass(frozen=True)
class Written:
    """What became of a bag that was made of another one.

    Attributes:
        messages: How many messages were saved; None where all were converted.
        notes: What there is to say of it, a sentence each.
    """

    messages: int | None
    notes: tuple[str, ...]


def inspect(path: Path, *, read_all: bool = False) -> BagContents:
    """Return what the bag at a path holds.

    Args:
        path: A file, or the folder of a bag of ROS 2.
        read_all: Read and decode every message, which takes time, to find what an index does not tell.

    Raises:
        ConfigurationError: There is no bag, or it cannot be opened.
        EvidenceError: Nothing was written in it, or looking at it takes more memory or time than one of its size may.
    """
    bag = find(path)
    found = _asked(bag, {"do": "inspect", "all": read_all})
    return BagContents(
        bag.format,
        bag.size_bytes,
        tuple(BagTopic(*one) for one in found["topics"]),
        found["started_utc_ns"],
        found["duration_s"],
        found["compression"],
        tuple(found["problems"]),
        found["saved"]["messages"] if "saved" in found else None,
    )


def repair(path: Path, to: Path) -> Written:
    """Write what can be read of a damaged bag into a new one of the same format, with an index; the old one stays.

    Raises:
        ConfigurationError: As `inspect`; or `to` is there already, or its name is not one for the format.
        EvidenceError: As `inspect`; or no message can be read.
    """
    bag = find(path)
    if (bag.format is BagFormat.ROS1) != (to.suffix == ".bag"):
        wanted = "NAME.bag" if bag.format is BagFormat.ROS1 else "a folder, whose name does not end in .bag"
        raise ConfigurationError(
            f"a saved bag keeps its format, {bag.format}: the new one is {wanted}", where=str(to)
        )

    def ask(place: Path) -> Written:
        found = _asked(bag, {"do": "repair", "to": str(place)})
        if not found["messages"]:
            why = f"no message can be saved: {found['why']}"
            raise EvidenceError(why, where=str(path), remedy=LAST_RESORT.get(bag.format, ""))
        return Written(found["messages"], (found["why"],) if found["why"] else ())

    return _written(to, ask)


def convert(path: Path, to: Path, *, storage: BagFormat = BagFormat.MCAP, distribution: str = "") -> Written:
    """Write a bag in another format: `NAME.bag` for ROS 1, else a folder for ROS 2.

    Args:
        path: A whole bag.
        to: The new one.
        storage: What a bag of ROS 2 is made of.
        distribution: Whose message types it has; those of Noetic or Jazzy if empty.

    Raises:
        ConfigurationError: As `inspect`; or `to` is there already, or the distribution is not one for its format.
        EvidenceError: As `inspect`; or the bag is damaged, or cannot be converted.
    """
    bag, is_ros1 = find(path), to.suffix == ".bag"
    distribution = distribution or ("noetic" if is_ros1 else "jazzy")
    if (distribution == "noetic") != is_ros1:
        raise ConfigurationError(
            f"{distribution} is ROS {'1' if distribution == 'noetic' else '2'}",
            where=str(to),
            remedy="call the new bag NAME.bag for ROS 1, or otherwise for ROS 2",
        )
    contents = inspect(path)
    if contents.problems:
        raise EvidenceError(
            f"the bag is damaged: {contents.problems[0]}",
            where=str(path),
            remedy=typed("fieldkit", "bag", "repair", path, "NEW"),
        )
    question = {"do": "convert", "storage": storage.value, "distribution": distribution}
    return _written(to, lambda place: Written(None, tuple(_asked(bag, question | {"to": str(place)})["notes"])))


def _written(to: Path, write: Callable[[Path], Written]) -> Written:
    """Let a bag be written beside its place, and put it there when it is whole."""
    if to.exists() or to.is_symlink():
        raise ConfigurationError("something is there already", where=str(to), remedy="choose another name")
    try:
        with tempfile.TemporaryDirectory(prefix=f".{to.name}-", dir=to.parent) as folder:
            place = Path(folder, to.name)
            found = write(place.absolute())
            place.rename(to)
    except OSError as error:
        raise ConfigurationError(
            f"cannot write there: {error.strerror or error}",
            where=str(to),
            remedy="name a place in a folder that is there, and that you may write to",
        ) from error
    return found


def _asked(bag: BagFiles, question: Json) -> Json:
    size_bytes = _GROWS * sum(given_bytes(file) for file in bag.files)
    try:
        return _WORKER.ask({"path": str(bag.path.absolute()), **question}, size_bytes)
    except ConfinedAnswerError as error:
        raise EvidenceError(f"the bag cannot be read: {error}", where=str(bag.path)) from error
