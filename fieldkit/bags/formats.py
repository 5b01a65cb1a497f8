"""Formats of bags, told by the first bytes of their files."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from fieldkit.core.errors import EvidenceError, typed
from fieldkit.measure.evidence.bag import METADATA

_ROS1_SUFFIXES: Final = {".bag", ".active"}
_MAGIC_BYTES: Final = 16


class BagFormat(StrEnum):
    """What a bag is made of; its value is how people and `--storage` call it."""

    ROS1 = "ros1"
    SQLITE = "sqlite3"
    MCAP = "mcap"


_MAGIC: Final = {
    b"#ROSBAG V2.0\n": BagFormat.ROS1,
    b"SQLite format 3\0": BagFormat.SQLITE,
    b"\x89MCAP0\r\n": BagFormat.MCAP,
}
"""wiki.ros.org/Bags/Format/2.0; sqlite.org/fileformat.html, 1.3; mcap.dev/spec, "Magic"."""

_COMPRESSED: Final = {
    b"\x1f\x8b": "gunzip -k",
    b"BZh": "bunzip2 -k",
    b"\xfd7zXZ\0": "unxz -k",
    b"\x28\xb5\x2f\xfd": "unzstd",
    b"\x04\x22\x4d\x18": "unlz4",
    b"PK\x03\x04": "unzip",
}
"""What unpacks a whole file, by its first bytes (RFC 1952, 8878; the formats' own descriptions)."""


@dataclass(frozen=True)
class BagFiles:
    """Where a bag lies.

    Attributes:
        path: As it was named: a file, or the folder of a bag of ROS 2.
        format: What it is made of.
        files: Its data files, in the order of their names, which is that of recording.
        closed: Whether its recorder wrote the metadata of a bag of ROS 2; always so for ROS 1, whose index is inside.
    """

    path: Path
    format: BagFormat
    files: tuple[Path, ...]
    closed: bool

    @property
    def size_bytes(self) -> int:
        """The size of all data files."""
        return sum(file.stat().st_size for file in self.files)


def find(path: Path) -> BagFiles:
    """Return the bag at a path: a file of any format, or the folder that ROS 2 makes.

    Raises:
        EvidenceError: There is nothing, it cannot be read, or it is no bag.
    """
    try:
        if path.is_dir():
            return _in_folder(path)
        return _of_file(path, _format(path))
    except OSError as error:
        raise EvidenceError(f"the bag cannot be read: {error.strerror or error}", where=str(path)) from error


def _of_file(path: Path, form: BagFormat) -> BagFiles:
    if form is BagFormat.ROS1:
        if path.suffix not in _ROS1_SUFFIXES:
            raise EvidenceError(
                "a bag of ROS 1 is called NAME.bag", where=str(path), remedy=typed("mv", path, f"{path}.bag")
            )
        return BagFiles(path, form, (path,), closed=True)
    if not (path.parent / METADATA).is_file():
        return BagFiles(path, form, (path,), closed=False)
    whole = _in_folder(path.parent)
    return whole if whole.files == (path,) else BagFiles(path, form, (path,), closed=True)


def _in_folder(folder: Path) -> BagFiles:
    found = [(file, form) for file in sorted(folder.iterdir()) if (form := _format_or_none(file)) is not None]
    formats = {form for _, form in found}
    if not formats:
        raise EvidenceError(
            "no bag is in this folder", where=str(folder), remedy="name a .bag, .db3 or .mcap file, or its own folder"
        )
    if len(formats) > 1 or formats == {BagFormat.ROS1}:
        files = ", ".join(file.name for file, _ in found)
        raise EvidenceError(f"this folder holds several bags: {files}", where=str(folder), remedy="name one of them")
    return BagFiles(folder, formats.pop(), tuple(file for file, _ in found), (folder / METADATA).is_file())


def _format(file: Path) -> BagFormat:
    form = _format_or_none(file)
    if form is None:
        with file.open("rb") as opened:
            head = opened.read(_MAGIC_BYTES)
        if not head:
            problem, remedy = "the file is empty", "was the recorder ended before it wrote anything?"
        elif unpack := next((program for magic, program in _COMPRESSED.items() if head.startswith(magic)), ""):
            problem, remedy = "this file is compressed as a whole", f"{typed(*unpack.split(), file)}, then try again"
        else:
            problem, remedy = (
                "this is no bag of ROS 1, SQLite or MCAP",
                "name a .bag, .db3 or .mcap file, or its folder",
            )
        raise EvidenceError(problem, where=str(file), remedy=remedy)
    return form


def _format_or_none(file: Path) -> BagFormat | None:
    if not file.is_file() and file.exists():
        return None
    with file.open("rb") as opened:
        head = opened.read(_MAGIC_BYTES)
    return next((form for magic, form in _MAGIC.items() if head.startswith(magic)), None)
