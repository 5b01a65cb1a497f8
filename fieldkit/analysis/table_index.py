"""An index of many tables: a file in the user's cache with their parsed rows.

An entry is used only if the table and the `trial.yaml` next to it have not changed since they were read: device,
inode, size, modification time and change time must be the same. A program can restore a modification time, but not
the change time. A file that changed less than `SETTLED_S` before it was read has no entry, because a later change
within the resolution of the time stamps would not be detected.

The file consists of a Parquet file, a JSON description of the tables, the length of the description, a digest
(BLAKE2b) of these parts, and `MAGIC`. A file that is damaged or belongs to another user is ignored.
"""

import errno
import hashlib
import json
import os
import stat
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from numpy.typing import NDArray

from fieldkit.analysis.parsing import Numbers, Texts, arrow_columns, arrow_type
from fieldkit.core.columns import Column

MAGIC: Final = b"fkindex1"
SETTLED_S: Final = 2.0
"""Coarsest resolution of time stamps (FAT), in seconds."""
MAX_FILES: Final = 20
"""Maximum number of indexes in the cache."""
_DIGEST_BYTES: Final = 32
_LENGTH_BYTES: Final = 8
_SUFFIX: Final = ".index"
_TEMPORARY_SUFFIX: Final = ".new"
_MAX_TEMPORARY_AGE_S: Final = 86_400
"""Older temporary files are removed, because the process that created them was killed."""


class FileStamp(NamedTuple):
    """Properties of a file that change if its content changes."""

    device: int
    inode: int
    size: int
    modified_ns: int
    changed_ns: int

    @classmethod
    def of(cls, status: os.stat_result) -> "FileStamp":
        """Return the stamp of a file."""
        return cls(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)

    def is_settled(self, now_ns: int) -> bool:
        """Return True if the file did not change in the last `SETTLED_S`."""
        return max(self.modified_ns, self.changed_ns) < now_ns - SETTLED_S * 1e9


TableStamp = tuple[FileStamp, FileStamp | None]
"""Stamps of a table and of the `trial.yaml` next to it; None if there is no such file."""


def stamp(table: Path, plan: Path) -> TableStamp | None:
    """Return the stamps of a table and its plan; None, so that the table is not indexed, if that is not possible.

    The table must be a readable regular file, and the plan must be one, too, or missing.
    """
    try:
        table_status = table.stat()
    except OSError:
        return None
    if not stat.S_ISREG(table_status.st_mode):
        return None
    try:
        plan_status = plan.lstat()
    except FileNotFoundError:
        return FileStamp.of(table_status), None
    except OSError:
        return None
    return (FileStamp.of(table_status), FileStamp.of(plan_status)) if stat.S_ISREG(plan_status.st_mode) else None


@dataclass(frozen=True)
class TableFacts:
    """The properties of a table that are needed before its rows.

    Attributes:
        names: Names of the table's columns.
        declarations: Columns that the table's plan declares, as JSON.
        expected: Expectations in the table's plan.
    """

    names: tuple[str, ...]
    declarations: str
    expected: tuple[str, ...]


@dataclass(frozen=True)
class Entry:
    """A table in an index.

    Attributes:
        path: Absolute path of the table when it was read.
        stamp: Stamps of the table.
        facts: Properties of the table.
        start: Index of the table's first row.
        rows: Number of the table's rows; negative if a value is invalid, so that the table must be read from its
            file.
    """

    path: str
    stamp: TableStamp
    facts: TableFacts
    start: int
    rows: int


@dataclass(frozen=True, eq=False)
class TableIndex:
    """The content of an index file.

    Attributes:
        entries: The tables by their stamps.
        content: The Parquet file.
        types: Types of the columns by name, as text.
    """

    entries: Mapping[TableStamp, Entry] = field(default_factory=dict)
    content: pa.Buffer | None = None
    types: Mapping[str, str] = field(default_factory=dict)

    def has_types(self, declared: Iterable[Column]) -> bool:
        """Return True if each column that is in the index has the same type there."""
        return all(self.types.get(column.name) in {None, type_name(column)} for column in declared)

    def read(
        self, entries: Sequence[Entry], declared: Mapping[str, Column]
    ) -> tuple[dict[str, Numbers], dict[str, Texts]]:
        """Return the rows of some tables in order, in the form of `parsing.columns`.

        Raises:
            pa.ArrowException: The index is damaged.
        """
        file = pa.parquet.ParquetFile(pa.BufferReader(self.content))
        present = [name for name in declared if name in self.types]
        table = file.read(columns=present, use_threads=True)
        columns_by_name = {name: table.column(name).cast(arrow_type(declared[name])) for name in present}
        numbers, texts = arrow_columns(columns_by_name, declared, len(table))
        selection = _row_indices(entries)
        if len(selection) == len(table) and (selection == np.arange(len(table))).all():
            return numbers, texts
        return (
            {name: column[selection] for name, column in numbers.items()},
            {name: column[selection] for name, column in texts.items()},
        )


def _row_indices(entries: Iterable[Entry]) -> NDArray[np.int64]:
    return np.concatenate(
        [np.arange(entry.start, entry.start + entry.rows) for entry in entries] or [np.empty(0, np.int64)]
    )


_TYPES: Final = {
    "text": pa.dictionary(pa.int32(), pa.string()),
    **{str(kind): kind for kind in (pa.bool_(), pa.int64(), pa.float64())},
}


def type_name(column: Column) -> str:
    """Return the type of a column in an index, as text."""
    kind = arrow_type(column)
    return next(name for name, arrow_kind in _TYPES.items() if arrow_kind == kind)


def cache_folder() -> Path:
    """Return the folder of indexes: `fieldkit/tables` in `XDG_CACHE_HOME`, by default `~/.cache`."""
    base = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (base if base.is_absolute() else Path.home() / ".cache") / "fieldkit" / "tables"


def index_path(tables: Sequence[str]) -> Path:
    """Return the index file of tables with these absolute paths. Each common parent folder has one index file."""
    common = os.path.commonpath(tables)
    return cache_folder() / f"{hashlib.blake2b(os.fsencode(common), digest_size=16).hexdigest()}{_SUFFIX}"


def load(path: Path) -> TableIndex:
    """Return the index in a file. The index is empty if the file is missing, damaged or of another version.

    Raises:
        OSError: The file cannot be read, or another user can write the file or its folder.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        return TableIndex()
    with os.fdopen(descriptor, "rb") as file:
        for status in (path.parent.stat(), os.fstat(descriptor)):
            _require_private(status, path)
        content = file.read() if stat.S_ISREG(os.fstat(descriptor).st_mode) else b""
    tail = len(MAGIC) + _DIGEST_BYTES
    if not content.endswith(MAGIC) or len(content) < tail + _LENGTH_BYTES:
        return TableIndex()
    body = memoryview(content)[:-tail]
    if _digest(body) != content[-tail : -len(MAGIC)]:
        return TableIndex()
    split = len(body) - _LENGTH_BYTES - int.from_bytes(body[-_LENGTH_BYTES:], "big")
    description = json.loads(bytes(body[split:-_LENGTH_BYTES]))
    if description["version"] != _version():
        return TableIndex()
    return TableIndex(dict(_entries(description)), pa.py_buffer(body[:split]), description["types"])


def _require_private(status: os.stat_result, path: Path) -> None:
    """Raise PermissionError if another user owns a file or folder, or can write it."""
    if status.st_uid != os.geteuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(errno.EPERM, "another user can write it", str(path))


def _digest(content: Any) -> bytes:  # noqa: ANN401 (any buffer)
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest()


def _version() -> list[str]:
    return [version("fieldkit"), pa.__version__]


def _entries(description: Mapping[str, Any]) -> Iterator[tuple[TableStamp, Entry]]:
    facts = [TableFacts(tuple(names), text, tuple(expected)) for names, text, expected in description["facts"]]
    for path, table, plan, number, start, rows in description["tables"]:
        stamps = FileStamp(*table), plan and FileStamp(*plan)
        yield stamps, Entry(path, stamps, facts[number], start, rows)


def _description(entries: Iterable[Entry], types: Mapping[str, str]) -> bytes:
    """Return the JSON description of the tables; equal facts of several tables are stored once."""
    number_by_facts: dict[TableFacts, int] = {}
    tables = [
        (
            entry.path,
            *entry.stamp,
            number_by_facts.setdefault(entry.facts, len(number_by_facts)),
            entry.start,
            entry.rows,
        )
        for entry in entries
    ]
    facts = [(fact.names, fact.declarations, fact.expected) for fact in number_by_facts]
    return json.dumps({"version": _version(), "types": types, "facts": facts, "tables": tables}).encode()


class IndexWriter:
    """Writes an index to a temporary file, which replaces the old index at the end.

    Args:
        file: The temporary file.
        types: Types of the columns of all tables by name, as in `TableIndex`.
    """

    def __init__(self, file: Any, types: Mapping[str, str]) -> None:  # noqa: ANN401 (a temporary file)
        self._file, self._types = file, types
        self._schema = pa.schema([(name, _TYPES[kind]) for name, kind in types.items()])
        self._writer = pa.parquet.ParquetWriter(file, self._schema, compression="zstd")
        self._entries: list[Entry] = []
        self._rows = 0

    def add(self, columns: Mapping[str, pa.ChunkedArray], tables: Iterable[Entry]) -> None:
        """Add the rows of some tables. Values of columns that the tables lack are missing.

        Args:
            columns: Arrow columns with the types of `arrow_type`.
            tables: The tables in the order of their rows. Their `start` is replaced.
        """
        total = 0
        for entry in tables:
            self._entries.append(Entry(entry.path, entry.stamp, entry.facts, self._rows + total, entry.rows))
            total += max(entry.rows, 0)
        if total:
            table = pa.table(
                [_column(columns.get(item.name), item.type, total) for item in self._schema], self._schema
            )
            self._writer.write_table(table)
        self._rows += total

    def copy(self, index: TableIndex, entries: Collection[Entry]) -> None:
        """Add tables of another index whose columns have the same types."""
        ordered = sorted(entries, key=lambda entry: entry.start)
        rows = pa.array(_row_indices(entry for entry in ordered if entry.rows > 0))
        table = pa.parquet.ParquetFile(pa.BufferReader(index.content)).read().take(rows)
        columns = {
            item.name: table.column(item.name).cast(item.type) for item in self._schema if item.name in index.types
        }
        self.add(columns, ordered)

    def finish(self) -> None:
        """Write the description and the digest."""
        self._writer.close()
        description = _description(self._entries, self._types)
        self._file.write(description + len(description).to_bytes(_LENGTH_BYTES, "big"))
        self._file.flush()
        self._file.seek(0)
        digest = hashlib.file_digest(self._file, lambda: hashlib.blake2b(digest_size=_DIGEST_BYTES)).digest()
        self._file.write(digest + MAGIC)


def _column(column: pa.ChunkedArray | None, kind: pa.DataType, rows: int) -> pa.ChunkedArray | pa.Array:
    """Return the column, or a column of missing values if it is None. A missing text is empty."""
    if column is not None:
        return column
    if pa.types.is_dictionary(kind):
        return pa.DictionaryArray.from_arrays(pa.array(np.zeros(rows, np.int32)), pa.array([""]))
    return pa.nulls(rows, kind)


@contextmanager
def replacing(path: Path, types: Mapping[str, str]) -> Iterator[IndexWriter]:
    """Replace an index file atomically at the end of the body.

    Raises:
        OSError: The file cannot be written. An existing index is unchanged.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    _require_private(path.parent.stat(), path.parent)
    descriptor, name = tempfile.mkstemp(_TEMPORARY_SUFFIX, path.name, path.parent)
    try:
        with os.fdopen(descriptor, "w+b") as file:
            writer = IndexWriter(file, types)
            yield writer
            writer.finish()
        Path(name).rename(path)
    except pa.ArrowException as error:
        raise OSError(errno.EIO, str(error), str(path)) from error
    finally:
        with suppress(FileNotFoundError):
            Path(name).unlink()
    _remove_old(path.parent)


def _remove_old(folder: Path) -> None:
    """Remove the oldest indexes beyond `MAX_FILES`, and temporary files of processes that were killed."""
    with suppress(OSError):  # another process has removed it
        newest_first = sorted(folder.glob(f"*{_SUFFIX}"), key=lambda path: path.stat().st_mtime_ns, reverse=True)
        old_temporary_files = [
            path
            for path in folder.glob(f"*{_TEMPORARY_SUFFIX}")
            if path.stat().st_mtime < time.time() - _MAX_TEMPORARY_AGE_S
        ]
        for path in (*newest_first[MAX_FILES:], *old_temporary_files):
            path.unlink()
