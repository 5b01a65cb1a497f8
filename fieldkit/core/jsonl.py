"""A file of JSON lines that only grows: on disk before anything goes on, readable after any crash."""

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
"""Makes an entry of a JSON value; raises ValueError, KeyError or TypeError for what is none."""

_LIMIT_BYTES: Final = 1 << 28
"""A line of a journal has some 120 bytes, so this holds far more than any trial."""


@contextmanager
def claimed(path: Path, what: str) -> Iterator[None]:
    """Keep every other fieldkit off a file while the body runs.

    Args:
        path: The file; made if there is none.
        what: What it is the journal of, for the message.

    Raises:
        ConfigurationError: Another one has it, or it cannot be written.
    """
    try:
        descriptor = files.open_plain(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}",
            where=str(path),
            remedy="mend that, or go on in a copy of it",
        ) from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigurationError(
                f"another fieldkit runs this {what}",
                where=str(path.parent),
                remedy="wait until it has ended, or end it",
            ) from error
        yield
    finally:
        os.close(descriptor)


def append(path: Path, *records: Mapping[str, Any]) -> None:
    """Add a line per record and wait until they are on disk.

    Raises:
        OSError: The disk is full or gone; the file is as it was before.
    """
    lines = "".join(json.dumps(record) + "\n" for record in records).encode()
    descriptor = files.open_plain(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        before = os.fstat(descriptor).st_size
        if os.write(descriptor, lines) != len(lines):
            os.ftruncate(descriptor, before)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def mend(path: Path, parse: Parse[object]) -> None:
    """Take a last line that a crash has torn off the file, so that the next one begins a line of its own."""
    try:
        content = files.read(path, _LIMIT_BYTES)
    except FileNotFoundError:
        return
    torn = content.rpartition(b"\n")[2]
    if not torn:
        return
    try:
        parse(json.loads(torn.decode()))
    except JSON_ERRORS:
        os.truncate(path, len(content) - len(torn))
    else:
        with path.open("ab") as file:
            file.write(b"\n")


def read(path: Path, parse: Parse[Entry], *, remedy: str) -> list[Entry]:
    """Return the entries of a file; a last line torn by a crash is left out.

    Args:
        path: The file.
        parse: Makes an entry of a line.
        remedy: What to do when there is no such file.

    Raises:
        EvidenceError: There is no such file, or a line that no crash has torn cannot be read.
    """
    try:
        content = files.read(path, _LIMIT_BYTES)
    except OSError as error:
        raise EvidenceError(f"no journal: {error.strerror}", where=str(path), remedy=remedy) from error
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
