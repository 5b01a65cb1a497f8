"""Formats of bags, which are detected by the first bytes of their files."""

import os
import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError, EvidenceError, shell_command
from fieldkit.ros.bags.bag import METADATA

_ROS1_SUFFIXES: Final = {".bag", ".active"}
_MAGIC_BYTES: Final = 16
"""Number of bytes that are read to detect a format: the length of the longest magic number."""


class BagFormat(StrEnum):
    """Format of a bag; the value is the name for users and for `--storage`."""

    ROS1 = "ros1"
    SQLITE = "sqlite3"
    MCAP = "mcap"


_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
"""Magic number at the start of a file, and also at the end of a complete one, after the index."""

_MAGIC: Final = {
    b"#ROSBAG V2.0\n": BagFormat.ROS1,
    b"SQLite format 3\0": BagFormat.SQLITE,
    _MCAP_MAGIC: BagFormat.MCAP,
}
"""Format of a file by its magic number (wiki.ros.org/Bags/Format/2.0; sqlite.org/fileformat.html, 1.3; mcap.dev/spec,
"Magic")."""

_WHAT_TO_NAME: Final = "name a .bag, .db3 or .mcap file, or its folder"

_COMPRESSED: Final = {
    b"\x1f\x8b": "gunzip -k",
    b"BZh": "bunzip2 -k",
    b"\xfd7zXZ\0": "unxz -k",
    b"\x28\xb5\x2f\xfd": "unzstd",
    b"\x04\x22\x4d\x18": "unlz4",
    b"PK\x03\x04": "unzip",
}
"""Programs that decompress a file, by its first bytes (RFC 1952, 8878; the specifications of the other formats)."""


LAST_RESORT: Final = {BagFormat.SQLITE: "SQLite may read more of it: sqlite3 OLD.db3 .recover | sqlite3 NEW.db3"}
"""Commands that an operator can try if fieldkit cannot read any message."""


@dataclass(frozen=True)
class BagFiles:
    """The files of a bag.

    Attributes:
        path: The path that is opened: a file, or the folder of a ROS 2 bag. It is the folder also for a file that is
            the only data file of a folder with metadata.
        format: Its format.
        files: Its data files in the order of their numbers, which is the order of recording: `bag_2.mcap` is before
            `bag_10.mcap`.
        closed: Whether the recorder has written the metadata of a ROS 2 bag: metadata.yaml, or the end of a single
            MCAP file. Always True for ROS 1, whose index is in the file and is checked later.
    """

    path: Path
    format: BagFormat
    files: tuple[Path, ...]
    closed: bool

    @property
    def size_bytes(self) -> int:
        """Total size of the data files."""
        return sum(file.stat().st_size for file in self.files)


def find(path: Path) -> BagFiles:
    """Return the bag at a path: a file of any format, or the folder of a ROS 2 bag.

    Raises:
        ConfigurationError: The path does not exist, cannot be opened, is not a bag, or is a folder with several bags.
        EvidenceError: The file is empty or begins with zeros.
    """
    try:
        if path.is_dir():
            return _bag_in_folder(path)
        return _bag_from_file(path, _format(path))
    except OSError as error:
        where = Path(error.filename or path)
        raise ConfigurationError(
            f"the bag cannot be read: {error.strerror or error}",
            where=str(where),
            remedy=shell_command("ls", "-l", where.parent),
        ) from error


def _bag_from_file(path: Path, bag_format: BagFormat) -> BagFiles:
    """Return the bag of a data file: its folder if that has metadata and no other data file, else the file alone."""
    if bag_format is BagFormat.ROS1:
        if path.suffix not in _ROS1_SUFFIXES:
            raise ConfigurationError(
                "a ROS 1 bag must be named NAME.bag", where=str(path), remedy=shell_command("mv", path, f"{path}.bag")
            )
        return BagFiles(path, bag_format, (path,), closed=True)
    if not (path.parent / METADATA).is_file():
        return BagFiles(path, bag_format, (path,), _is_closed_mcap(path, bag_format))
    folder_bag = _bag_in_folder(path.parent)
    return folder_bag if folder_bag.files == (path,) else BagFiles(path, bag_format, (path,), closed=True)


def _bag_in_folder(folder: Path) -> BagFiles:
    """Return the bag in a folder: a ROS 2 bag with one or more data files, or a single file without metadata."""
    files = sorted((file for file in folder.iterdir() if file.is_file()), key=_numbers_by_value)
    bag_files = [(file, bag_format) for file in files if (bag_format := _format_or_none(file)) is not None]
    if len(bag_files) == 1 and not (folder / METADATA).is_file():
        return _bag_from_file(*bag_files[0])
    formats = {bag_format for _, bag_format in bag_files}
    if not formats:
        raise ConfigurationError("there is no bag in this folder", where=str(folder), remedy=_WHAT_TO_NAME)
    if len(formats) > 1 or formats == {BagFormat.ROS1}:
        names = ", ".join(file.name for file, _ in bag_files)
        raise ConfigurationError(
            f"this folder contains several bags: {names}", where=str(folder), remedy="name one of them"
        )
    return BagFiles(folder, formats.pop(), tuple(file for file, _ in bag_files), (folder / METADATA).is_file())


def _numbers_by_value(file: Path) -> tuple[str | int, ...]:
    """Return a sort key of a file name that orders numbers by their value."""
    return tuple(int(part) if index % 2 else part for index, part in enumerate(re.split(r"([0-9]+)", file.name)))


def _is_closed_mcap(file: Path, bag_format: BagFormat) -> bool:
    """Return True if a file has the end mark of a closed recording, which exists only in MCAP files."""
    if bag_format is not BagFormat.MCAP:
        return False
    with file.open("rb") as stream:
        stream.seek(-len(_MCAP_MAGIC), os.SEEK_END)
        return stream.read() == _MCAP_MAGIC


def _format(file: Path) -> BagFormat:
    """Return the format of a file; raise an error with the probable cause if it is not a bag."""
    if file.exists() and not file.is_file():
        raise ConfigurationError("this is neither a file nor a folder", where=str(file), remedy=_WHAT_TO_NAME)
    bag_format = _format_or_none(file)
    if bag_format is not None:
        return bag_format
    head = _head(file)
    if not head.strip(b"\0"):
        problem = "the file is empty" if not head else "the file begins with zeros"
        remedy = "was the recorder stopped, or its power cut, before the file was written to disk?"
        raise EvidenceError(problem, where=str(file), remedy=remedy)
    if unpack := next((program for magic, program in _COMPRESSED.items() if head.startswith(magic)), ""):
        problem, remedy = (
            "this file is compressed as a whole",
            f"{shell_command(*unpack.split(), file)}, then try again",
        )
    else:
        problem, remedy = "this is not a bag of ROS 1, SQLite or MCAP", _WHAT_TO_NAME
    raise ConfigurationError(problem, where=str(file), remedy=remedy)


def _format_or_none(file: Path) -> BagFormat | None:
    head = _head(file)
    return next((bag_format for magic, bag_format in _MAGIC.items() if head.startswith(magic)), None)


def _head(file: Path) -> bytes:
    with file.open("rb") as stream:
        return stream.read(_MAGIC_BYTES)
