"""Files that a crash leaves whole, and the disk that they need."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a file that takes the place of `path` when the body ends: a crash leaves one of the two, whole.

    A file that was there keeps its mode; when the body raises, it stays.

    Raises:
        OSError: It cannot be written; what was there stays.
    """
    temporary = path.with_name(f".{path.name}.new")
    try:
        with temporary.open("wb") as file:
            if path.exists():
                os.fchmod(file.fileno(), path.stat().st_mode & 0o7777)
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.rename(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def write(path: Path, content: bytes) -> None:
    """Write a file whole, as `replacing`.

    Raises:
        OSError: It cannot be written; what was there stays.
    """
    with replacing(path) as file:
        file.write(content)


def sync_folder(folder: Path) -> None:
    """Return when the names in a folder are on disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def existing(folder: Path) -> Path:
    """Return a folder, or the innermost of those around it that is there already."""
    whole = folder.absolute()
    return next(path for path in (whole, *whole.parents) if path.is_dir())


def free_bytes(folder: Path) -> int:
    """Return how many bytes are free on the disk that `folder` is on, or will be."""
    return shutil.disk_usage(existing(folder)).free
