"""Bytes and text of evidence files, with errors that say what to do."""

import os
from mmap import ACCESS_READ, mmap
from pathlib import Path

from fieldkit.core.errors import EvidenceError


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


def text(path: Path) -> str:
    """Return a tool's output, bytes that are no UTF-8 replaced; raises `EvidenceError` as `content` does."""
    return content(path).decode(errors="replace")


def _unreadable(path: Path, error: OSError) -> EvidenceError:
    return EvidenceError(
        f"cannot be read: {error.strerror or error}", where=str(path), remedy="repeat the measurement"
    )
