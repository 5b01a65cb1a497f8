"""Append-only files of JSON lines.

`append` waits until its lines are on disk. `read` omits an incomplete last line.
"""

import errno
import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.core.text import JSON_ERRORS

Entry = TypeVar("Entry")
Parse = Callable[[Any], Entry]
"""Converts a JSON value to an entry; raises ValueError, KeyError or TypeError for any other value."""

_LIMIT_BYTES: Final = 1 << 28
"""Size limit of a file. A line of a journal has about 120 bytes, so no trial reaches it."""


@contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Lock a file against other fieldkit processes while the body runs.

    Args:
        path: The file; created if it does not exist.
        what: Subject of the journal, for the message: `trial`.

    Raises:
        ConfigurationError: Another process holds the lock, or the file cannot be written.
    """
    try:
        descriptor = files.open_plain(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}",
            where=str(path),
            remedy="make it writable, or continue in a copy of the folder",
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigurationError(
                f"another fieldkit process runs this {what}",
                where=str(path.parent),
                remedy="wait until it has exited, or stop it",
            ) from error
        yield
    finally:
        os.close(descriptor)


def append(path: Path, *records: Mapping[str, Any]) -> None:
    """Append one line per record and wait until the lines are on disk.

    Raises:
        OSError: The disk is full or unavailable; the file is unchanged, unless only the sync failed.
    """
    lines = "".join(json.dumps(record) + "\n" for record in records).encode()
    descriptor = files.open_plain(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        old_size = os.fstat(descriptor).st_size
        if os.write(descriptor, lines) != len(lines):
            os.ftruncate(descriptor, old_size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def repair_last_line(path: Path, parse: Parse[object]) -> None:
    """Remove an incomplete last line that a crash left, or add its missing line feed, before lines are appended."""
    try:
        content = files.read(path, _LIMIT_BYTES)
    except FileNotFoundError:
        return
    incomplete_line = content.rpartition(b"\n")[2]
    if not incomplete_line:
        return
    try:
        parse(json.loads(incomplete_line.decode()))
    except JSON_ERRORS:
        os.truncate(path, len(content) - len(incomplete_line))
    else:
        with path.open("ab") as file:
            file.write(b"\n")


def read(path: Path, parse: Parse[Entry], *, remedy: str) -> list[Entry]:
    """Return the entries of a file, without an incomplete last line that a crash left.

    Args:
        path: The file.
        parse: Converts the JSON value of a line to an entry.
        remedy: What to do if the file cannot be read.

    Raises:
        EvidenceError: The file does not exist or cannot be read, or a complete line is not an entry.
    """
    try:
        content = files.read(path, _LIMIT_BYTES)
    except OSError as error:
        raise EvidenceError(
            f"the journal cannot be read: {error.strerror}", where=str(path), remedy=remedy
        ) from error
    lines = content.decode(errors="replace").removesuffix("\n").split("\n") if content else []
    entries = []
    for number, line in enumerate(lines, start=1):
        try:
            entries.append(parse(json.loads(line)))
        except JSON_ERRORS as error:
            if number == len(lines) and not content.endswith(b"\n"):
                break
            raise EvidenceError(
                "not a journal entry", where=f"{path}:{number}", remedy="restore the file from a copy"
            ) from error
    return entries
