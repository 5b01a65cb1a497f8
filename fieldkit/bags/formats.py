"""Formats of bags, told by the first bytes of their files."""

import os
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError, EvidenceError, typed
from fieldkit.measure.evidence.bag import METADATA

_ROS1_SUFFIXES: Final = {".bag", ".active"}
_MAGIC_BYTES: Final = 16


class BagFormat(StrEnum):
    """What a bag is made of; its value is how people and `--storage` call it."""

    ROS1 = "ros1"
    SQLITE = "sqlite3"
    MCAP = "mcap"


_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
"""Stands at the end of a whole file, too, behind its index."""

_MAGIC: Final = {
    b"#ROSBAG V2.0\n": BagFormat.ROS1,
    b"SQLite format 3\0": BagFormat.SQLITE,
    _MCAP_MAGIC: BagFormat.MCAP,
}
"""wiki.ros.org/Bags/Format/2.0; sqlite.org/fileformat.html, 1.3; mcap.dev/spec, "Magic"."""

_WHAT_TO_NAME: Final = "name a .bag, .db3 or .mcap file, or its own folder"

_COMPRESSED: Final = {
    b"\x1f\x8b": "gunzip -k",
    b"BZh": "bunzip2 -k",
    b"\xfd7zXZ\0": "unxz -k",
    b"\x28\xb5\x2f\xfd": "unzstd",
    b"\x04\x22\x4d\x18": "unlz4",
    b"PK\x03\x04": "unzip",
}
"""What unpacks a whole file, by its first bytes (RFC 1952, 8878; the formats' own descriptions)."""


LAST_RESORT: Final = {BagFormat.SQLITE: "SQLite may read more of it: sqlite3 OLD.db3 .recover | sqlite3 NEW.db3"}
"""What may help where fieldkit can read nothing."""


@dataclass(frozen=True)
class BagFiles:
    """Where a bag lies.

    Attributes:
        path: As it was named: a file, or the folder of a bag of ROS 2.
        format: What it is made of.
        files: Its data files, in the order of their names, which is that of recording.
        closed: Whether its recorder wrote the metadata of a bag of ROS 2, which a file of MCAP alone has inside;
            always so for ROS 1, whose index is inside.
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
        ConfigurationError: There is nothing, it cannot be opened, or it is no bag.
        EvidenceError: It is a file in which nothing was ever written.
    """
    try:
        if path.is_dir():
            return _in_folder(path)
        return _of_file(path, _format(path))
    except OSError as error:
        where = Path(error.filename or path)
        raise ConfigurationError(
            f"the bag cannot be read: {error.strerror or error}",
            where=str(where),
            remedy=typed("ls", "-l", where.parent),
        ) from error


def _of_file(path: Path, form: BagFormat) -> BagFiles:
    if form is BagFormat.ROS1:
        if path.suffix not in _ROS1_SUFFIXES:
            raise ConfigurationError(
                "a bag of ROS 1 is called NAME.bag", where=str(path), remedy=typed("mv", path, f"{path}.bag")
            )
        return BagFiles(path, form, (path,), closed=True)
    if not (path.parent / METADATA).is_file():
        return BagFiles(path, form, (path,), _closed_itself(path, form))
    whole = _in_folder(path.parent)
    return whole if whole.files == (path,) else BagFiles(path, form, (path,), closed=True)


def _in_folder(folder: Path) -> BagFiles:
    files = sorted(file for file in folder.iterdir() if file.is_file())
    found = [(file, form) for file in files if (form := _format_or_none(file)) is not None]
    if len(found) == 1 and not (folder / METADATA).is_file():
        return _of_file(*found[0])
    formats = {form for _, form in found}
    if not formats:
        raise ConfigurationError("no bag is in this folder", where=str(folder), remedy=_WHAT_TO_NAME)
    if len(formats) > 1 or formats == {BagFormat.ROS1}:
        names = ", ".join(file.name for file, _ in found)
        raise ConfigurationError(
            f"this folder holds several bags: {names}", where=str(folder), remedy="name one of them"
        )
    return BagFiles(folder, formats.pop(), tuple(file for file, _ in found), (folder / METADATA).is_file())


def _closed_itself(file: Path, form: BagFormat) -> bool:
    """Return whether a file says that its recorder closed it; one of SQLite never does."""
    if form is not BagFormat.MCAP:
        return False
    with file.open("rb") as opened:
        opened.seek(-len(_MCAP_MAGIC), os.SEEK_END)
        return opened.read() == _MCAP_MAGIC


def _format(file: Path) -> BagFormat:
    if file.exists() and not file.is_file():
        raise ConfigurationError("this is neither a file nor a folder", where=str(file), remedy=_WHAT_TO_NAME)
    form = _format_or_none(file)
    if form is not None:
        return form
    head = _head(file)
    if not head.strip(b"\0"):
        problem = "the file is empty" if not head else "the file begins with zeros"
        remedy = "was the recorder ended, or its power cut, before it was on disk?"
        raise EvidenceError(problem, where=str(file), remedy=remedy)
    if unpack := next((program for magic, program in _COMPRESSED.items() if head.startswith(magic)), ""):
        problem, remedy = "this file is compressed as a whole", f"{typed(*unpack.split(), file)}, then try again"
    else:
        problem, remedy = "this is no bag of ROS 1, SQLite or MCAP", _WHAT_TO_NAME
    raise ConfigurationError(problem, where=str(file), remedy=remedy)


def _format_or_none(file: Path) -> BagFormat | None:
    head = _head(file)
    return next((form for magic, form in _MAGIC.items() if head.startswith(magic)), None)


def _head(file: Path) -> bytes:
    with file.open("rb") as opened:
        return opened.read(_MAGIC_BYTES)
