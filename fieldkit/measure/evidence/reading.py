"""Bytes and text of evidence files, with errors that say what to do."""

import os
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO, Final

from fieldkit.core.errors import EvidenceError

_CHUNK_BYTES: Final = 1 << 16


def content(path: Path) -> bytes:
    """Return the bytes of one piece of evidence.

    Raises:
        EvidenceError: It is missing or cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error


def mapped(path: Path) -> bytes | mmap:
    """Return the bytes of one piece of evidence, mapped into memory; raises `EvidenceError` as `content` does."""
    try:
        with path.open("rb") as file:
            # Nothing cannot be mapped.
            return mmap(file.fileno(), 0, access=ACCESS_READ) if os.fstat(file.fileno()).st_size else b""
    except OSError as error:
        raise _unreadable(path, error) from error


def size_bytes(path: Path) -> int:
    """Return the size of one piece of evidence; raises `EvidenceError` as `content` does."""
    try:
        return path.stat().st_size
    except OSError as error:
        raise _unreadable(path, error) from error


def alike_bytes(folder: Path, one: str, other: str) -> int:
    """Return how many bytes two files in a folder have in common from the beginning on.

    Raises:
        EvidenceError: One is missing or cannot be read.
    """
    try:
        with (folder / one).open("rb") as left, (folder / other).open("rb") as right:
            return _alike_bytes(left, right)
    except OSError as error:
        raise _unreadable(Path(error.filename or folder), error) from error


def _alike_bytes(left: BinaryIO, right: BinaryIO) -> int:
    alike = 0
    while (mine := left.read(_CHUNK_BYTES)) == (theirs := right.read(_CHUNK_BYTES)) and mine:
        alike += len(mine)
    shorter = min(len(mine), len(theirs))
    differ = (at for at in range(shorter) if mine[at] != theirs[at])
    return alike + next(differ, shorter)


def text(path: Path) -> str:
    """Return a tool's output, bytes that are no UTF-8 replaced; raises `EvidenceError` as `content` does."""
    return content(path).decode(errors="replace")


def _unreadable(path: Path, error: OSError) -> EvidenceError:
    return EvidenceError(
        f"cannot be read: {error.strerror or error}", where=str(path), remedy="repeat the measurement"
    )
