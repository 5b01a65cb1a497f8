"""Bytes and text of evidence files, with errors that say what to do."""

import json
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar

from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import JSON_ERRORS

T = TypeVar("T")

MOST_TEXT_BYTES: Final = 64 << 20
"""No tool says more during a repeat: a ping of an hour at 10 a second is 3 MB."""

_PIECE_BYTES: Final = 1 << 20
_MOST_READ_BYTES: Final = 1 << 24
"""Most captures are smaller, and to hold them costs little."""


def size(path: Path) -> int:
    """Return how many bytes a piece of evidence has.

    Raises:
        EvidenceError: It is missing or cannot be read.
    """
    with _opened(path) as file:
        return file.seek(0, 2)


def same(folder: Path, one: str, other: str) -> bool:
    """Return whether two pieces of evidence are equal, byte for byte; raises `EvidenceError` as `size` does."""
    whole = size(folder / one)
    return whole == size(folder / other) and alike_bytes(folder, one, other) == whole


def mapped(path: Path) -> bytes | mmap:
    """Return the bytes of one piece of evidence; raises `EvidenceError` as `size` does.

    A large one is mapped into memory, and must not shrink while it is read, nor its disk fail: the kernel ends who
    looks at what is not there any more.
    """
    with _opened(path) as file:
        if file.seek(0, 2) > _MOST_READ_BYTES:
            return mmap(file.fileno(), 0, access=ACCESS_READ)
        file.seek(0)
        return file.read(_MOST_READ_BYTES)


def alike_bytes(folder: Path, one: str, other: str) -> int:
    """Return how many bytes two files in a folder have in common from the beginning on; raises as `size` does."""
    with _opened(folder / one) as left, _opened(folder / other) as right:
        alike = 0
        while (mine := left.read(_PIECE_BYTES)) == (theirs := right.read(_PIECE_BYTES)) and mine:
            alike += len(mine)
        shorter = min(len(mine), len(theirs))
        differ = (at for at in range(shorter) if mine[at] != theirs[at])
        return alike + next(differ, shorter)


def text(path: Path) -> str:
    """Return a tool's output, bytes that are no UTF-8 replaced.

    Raises:
        EvidenceError: It is missing, cannot be read, or is longer than what any tool says.
    """
    with _opened(path) as file:
        found = file.read(MOST_TEXT_BYTES + 1)
    if len(found) > MOST_TEXT_BYTES:
        raise EvidenceError(f"is longer than {MOST_TEXT_BYTES >> 20} MiB, as no tool's output is", where=str(path))
    return found.decode(errors="replace")


def json_lines(path: Path, parse: Callable[[Any], T], wrong: str) -> list[T]:
    """Return what stands in the lines of a log, a JSON value each; a last one that is not whole is left out.

    Args:
        path: The log.
        parse: Makes of a line's value what it says; raises one of `JSON_ERRORS` where it is none.
        wrong: What a wrong line does not: `does not say where the robot drove`.

    Raises:
        EvidenceError: As `text`; or a line is wrong.
    """
    found = []
    for number, line in enumerate(text(path).split("\n")[:-1], 1):
        try:
            found.append(parse(json.loads(line)))
        except JSON_ERRORS:
            raise EvidenceError(f"line {number} {wrong}", where=str(path)) from None
    return found


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open a piece of evidence; a pipe that nobody writes into, or a device without end, is none."""
    try:
        # Looked at when it is open: what is at the path may have become another thing since anybody looked before.
        with open(path, "rb", opener=_without_waiting) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise EvidenceError("is no file", where=str(path), remedy="repeat the measurement")
            yield file
    except OSError as error:
        raise EvidenceError(
            f"cannot be read: {error.strerror or error}", where=str(path), remedy="repeat the measurement"
        ) from error


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)
