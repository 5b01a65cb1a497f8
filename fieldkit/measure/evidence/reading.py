"""Reading of evidence files. Every error is an `EvidenceError` that contains the path of the file."""

import gzip
import os
import re
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO, Final

from fieldkit.core.errors import EvidenceError

MAX_TEXT_BYTES: Final = 64 << 20
"""Maximum size of a tool's output; ping with 10 requests per second for an hour prints 3 MB."""

_CHUNK_BYTES: Final = 1 << 20
_MAX_READ_BYTES: Final = 1 << 24
"""Files up to this size are read into memory; larger ones are mapped. Most captures are smaller."""


def size(path: Path) -> int:
    """Return the size of an evidence file in bytes.

    Raises:
        EvidenceError: The file is missing, cannot be read, or is not a regular file.
    """
    with _open_regular(path) as file:
        return file.seek(0, 2)


def have_equal_bytes(folder: Path, first: str, second: str) -> bool:
    """Return True if two evidence files have the same bytes. Raises the same errors as `size`."""
    size_bytes = size(folder / first)
    return size_bytes == size(folder / second) and common_prefix_bytes(folder, first, second) == size_bytes


def mapped(path: Path) -> bytes | mmap:
    """Return the bytes of an evidence file. Raises the same errors as `size`.

    A large file is mapped into memory. If it is truncated while it is used, or its disk fails, the kernel kills this
    process (SIGBUS).
    """
    with _open_regular(path) as file:
        if file.seek(0, 2) > _MAX_READ_BYTES:
            return mmap(file.fileno(), 0, access=ACCESS_READ)
        file.seek(0)
        return file.read(_MAX_READ_BYTES)


def common_prefix_bytes(folder: Path, first: str, second: str) -> int:
    """Return the length of the common prefix of two files in a folder, in bytes. Raises the same errors as `size`."""
    with _open_regular(folder / first) as left, _open_regular(folder / second) as right:
        common_bytes = 0
        while (left_chunk := left.read(_CHUNK_BYTES)) == (right_chunk := right.read(_CHUNK_BYTES)) and left_chunk:
            common_bytes += len(left_chunk)
        shorter = min(len(left_chunk), len(right_chunk))
        differences = (index for index in range(shorter) if left_chunk[index] != right_chunk[index])
        return common_bytes + next(differences, shorter)


def text(path: Path) -> str:
    """Return the text of a tool's output; bytes that are not UTF-8 are replaced.

    Raises:
        EvidenceError: The file is missing, cannot be read, is not a regular file, or is longer than `MAX_TEXT_BYTES`.
    """
    with _open_regular(path) as file:
        content = file.read(MAX_TEXT_BYTES + 1)
    if len(content) > MAX_TEXT_BYTES:
        raise EvidenceError(
            f"is longer than {MAX_TEXT_BYTES >> 20} MiB, the limit of a tool's output", where=str(path)
        )
    return content.decode(errors="replace")


def compressed(path: Path) -> bytes:
    """Return the first `MAX_TEXT_BYTES` of the content of a file in gzip format.

    Raises:
        EvidenceError: The file is missing, cannot be read, is not a regular file, or has another format.
    """
    size(path)  # raises an error if the file cannot be read
    try:
        with gzip.open(path, "rb") as file:
            return file.read(MAX_TEXT_BYTES)
    except (OSError, EOFError, zlib.error) as error:
        raise EvidenceError(f"cannot be read: {error}", where=str(path)) from error


@contextmanager
def _open_regular(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file; other types, such as a pipe without a writer or an endless device, are refused.

    Raises:
        EvidenceError: The file is missing, cannot be read, or is not a regular file.
    """
    try:
        # The type is checked after opening, because the path can be replaced between a check and the opening.
        with open(path, "rb", opener=_open_nonblocking) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise EvidenceError("is not a regular file", where=str(path), remedy="repeat the measurement")
            yield file
    except OSError as error:
        raise EvidenceError(
            f"cannot be read: {error.strerror or error}", where=str(path), remedy="repeat the measurement"
        ) from error


def _open_nonblocking(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)


_COUNT: Final = re.compile(r"# lines ([0-9]{1,9})\n", re.ASCII)


def counted_csv_text(header: str, lines: Iterable[str]) -> str:
    """Return the text of a CSV file.

    It starts with a comment that contains the number of data lines, which shows whether the file is complete.
    """
    data_lines = list(lines)
    return "".join(f"{line}\n" for line in (f"# lines {len(data_lines)}", header, *data_lines))


def read_counted_csv(path: Path, header: str, pattern: re.Pattern[str], error: str) -> list[re.Match[str]]:
    """Return the data lines of a file that `counted_csv_text` created, as matches of a pattern.

    A file without the number of lines is accepted, too; if whole lines at its end are missing, this is not detected.

    Args:
        path: The file.
        header: Header line of the file.
        pattern: Pattern that all other lines must match.
        error: Message if the file has another content, for example `is not a track of robots`.

    Raises:
        EvidenceError: For the same reasons as `text`, or the file is truncated or has another content.
    """
    content = text(path)
    count = _COUNT.match(content)
    first_line, *lines = content[count.end() if count else 0 :].split("\n")
    matches = [match for line in lines[:-1] if (match := pattern.fullmatch(line)) is not None]
    if first_line != header or lines[-1:] != [""] or len(matches) < len(lines) - 1:
        raise EvidenceError(error, where=str(path))
    if count and int(count[1]) != len(matches):
        raise EvidenceError(f"is truncated: it has {len(matches)} of {count[1]} lines", where=str(path))
    return matches
