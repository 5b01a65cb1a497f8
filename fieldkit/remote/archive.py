"""Reader of the tar archives that robots send. They may contain only regular files with short names.

Header layout: POSIX.1-2017, pax, "ustar Interchange Format". The reader of the standard library supports many
extensions, each of which would let a robot send unexpected content.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Final

from fieldkit.core.errors import EvidenceError
from fieldkit.remote.command import printable

MAX_FILES: Final = 500

_BLOCK: Final = 512  # bytes: the unit of the format
_CHUNK_BLOCKS: Final = 128  # blocks that are read together: 64 KiB
_NAME: Final = slice(0, 100)
_SIZE: Final = slice(124, 136)
_CHECKSUM: Final = slice(148, 156)
_TYPE: Final = slice(156, 157)
_PREFIX: Final = slice(345, 500)


@dataclass(frozen=True)
class TarMember:
    """A file in the archive.

    Attributes:
        name: Its name, at most 100 bytes of printable text; callers must check it further.
        chunks: Its content. Parts that are not read before the next member are skipped.
    """

    name: str
    chunks: Iterator[bytes]


def members(file: IO[bytes], robot: str) -> Iterator[TarMember]:
    """Yield the files of an archive in their order.

    Args:
        file: The archive, open at its start.
        robot: Name of the sending robot, for messages.

    Raises:
        EvidenceError: It is truncated or damaged, has more than `MAX_FILES` files, or members that are not files.
    """
    for number in range(MAX_FILES + 1):
        header = file.read(_BLOCK)
        if len(header) == _BLOCK and not any(header):
            return
        if number == MAX_FILES:
            raise EvidenceError(f"sent more than {MAX_FILES} files", where=robot)
        name, size = _parse(header, robot)
        chunks = _content(file, size, robot)
        yield TarMember(name, chunks)
        for _ in chunks:  # skip the part that the caller has not read
            pass


def _parse(header: bytes, robot: str) -> tuple[str, int]:
    if len(header) < _BLOCK:
        raise EvidenceError("its files arrived damaged: the archive ends early", where=robot)
    # The checksum is computed with spaces in the checksum field.
    total = sum(header) - sum(header[_CHECKSUM]) + 8 * ord(" ")
    if _octal(header[_CHECKSUM]) != total:
        raise EvidenceError("its files arrived damaged: a header fails its checksum", where=robot)
    raw = header[_NAME].rstrip(b"\0")
    name = printable(raw)
    size = _octal(header[_SIZE])
    is_regular_file = header[_TYPE] in {b"0", b"\0"} and not any(header[_PREFIX])
    if not is_regular_file or size is None or name.encode() != raw:
        raise EvidenceError(f"sent {name!r}, which is not a regular file with a valid name", where=robot)
    return name, size


def _octal(field: bytes) -> int | None:
    digits = field.strip(b"\0 ")
    return int(digits, 8) if digits and not digits.strip(b"01234567") else None


def _content(file: IO[bytes], size: int, robot: str) -> Iterator[bytes]:
    while size > 0:
        # In the archive the content is padded to whole blocks.
        requested = min(-(-size // _BLOCK), _CHUNK_BLOCKS) * _BLOCK
        chunk = file.read(requested)
        if len(chunk) < requested:
            raise EvidenceError("its files arrived damaged: the archive ends early", where=robot)
        yield chunk[:size]
        size -= len(chunk)
