"""Read tables of repeats: the trial.csv of one trial or of thousands of trials."""

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis import parsing, table_errors
from fieldkit.analysis.repeats import SOURCE, Repeats, by_name, header_names, parse_rows
from fieldkit.core.columns import SCHEMA_VERSION, Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError, shell_command
from fieldkit.core.model import FINAL_STATUSES

IDENTITY: Final = ("schema_version", "trial", "protocol", "repeat", "attempt", "status")
"""Columns that a table of repeats must have."""
_SPREADSHEET_MARKS: Final = {
    b"schema_version;": ("its cells are separated by semicolons", "with commas, and with points in numbers"),
    b"schema_version\t": ("its cells are separated by tabs", "with commas"),
    b"s\x00c\x00h\x00e\x00m\x00a\x00": ("its encoding is UTF-16", "as UTF-8"),
}
"""Problem and correct format, by the start of a header that a spreadsheet wrote in another format."""
_BATCH_BYTES: Final = 1 << 25
"""Number of bytes that are parsed together, approximately."""
_MAX_HEADER_BYTES: Final = 1 << 20
"""Maximum length of a header line that is read."""


def read(
    paths: Iterable[Path],
    declared: Iterable[Column],
    columns: Collection[str] | None = None,
    content: Callable[[Path], bytes] = Path.read_bytes,
    indexed: "IndexedRows | None" = None,
) -> Repeats:
    """Return the rows of many tables, in the order of `paths`. Values of columns that a table lacks are missing.

    Tables with the same header are parsed together, some tens of megabytes at a time, because starting pyarrow's
    parser takes longer than parsing the 40 rows of a trial.

    Args:
        paths: CSV files with the columns of trial.csv, whose schema version is at most `SCHEMA_VERSION`; or folders
            of datasets.
        declared: The columns of trial.csv.
        columns: Names of the columns to read; None for all columns. The columns of `IDENTITY` are always read.
        content: Function that reads the bytes of a table.
        indexed: Rows of some of the tables. They are used instead of the files.

    Raises:
        ConfigurationError: A file cannot be read, is not a table of repeats, or a newer version of fieldkit wrote it.
        EvidenceError: A line is invalid.
    """
    requested = None if columns is None else {*columns, *IDENTITY}
    columns_by_name = {
        name: column for name, column in by_name(declared).items() if requested is None or name in requested
    }
    batches: dict[bytes, _Batch] = {}
    parts: list[Repeats] = []
    table_numbers: list[NDArray[np.int64]] = []  # for each part, the index in `paths` of the table of each row

    def parse_batch(batch: _Batch) -> None:
        part, counts = batch.parse(columns_by_name)
        parts.append(part)
        table_numbers.append(np.repeat(batch.numbers, counts))

    indexed_paths = frozenset[Path]()
    paths = list(paths)
    if indexed is not None and (from_index := _read_indexed(indexed, paths, columns_by_name)) is not None:
        indexed_paths = indexed.tables
        parts.append(from_index[0])
        table_numbers.append(from_index[1])
    for number, path in enumerate(paths):
        if path in indexed_paths:
            continue
        if path.is_dir():
            dataset = _read_dataset(path, columns_by_name)
            parts.append(dataset)
            table_numbers.append(np.full(len(dataset), number))
            continue
        # A large table is read in blocks, unless `content` reads its bytes in another way.
        if content == Path.read_bytes and (large := _read_large(path, columns_by_name)) is not None:
            parts.append(large)
            table_numbers.append(np.full(len(large), number))
            continue
        header, body = _split(path, content)
        if header not in batches:
            batches[header] = _Batch(header, _header(path, header))
        _check_line_end(path, body)
        batches[header].add(number, path, body)
        if batches[header].size >= _BATCH_BYTES:
            parse_batch(batches.pop(header))
    for batch in batches.values():
        parse_batch(batch)
    rows = _concatenated(parts or [parse_rows((), b"", columns_by_name)])
    number_of_row = np.concatenate(table_numbers) if table_numbers else np.empty(0, np.int64)
    return rows if (np.diff(number_of_row) >= 0).all() else rows.where(np.argsort(number_of_row, kind="stable"))


class IndexedRows(Protocol):
    """Rows of tables that have already been parsed and checked."""

    @property
    def tables(self) -> frozenset[Path]:
        """The tables whose rows are available."""

    def read(
        self, tables: Sequence[Path], declared: Mapping[str, Column]
    ) -> tuple[dict[str, parsing.Numbers], dict[str, parsing.Texts], list[int]] | None:
        """Return columns as `parsing.columns` does, and the number of rows of each table.

        The result is None if the stored rows cannot be used.
        """


def _read_indexed(
    indexed: IndexedRows, paths: Sequence[Path], declared: Mapping[str, Column]
) -> tuple[Repeats, NDArray[np.int64]] | None:
    """Return the rows of the indexed tables, and for each row the index of its table in `paths`."""
    numbers = [number for number, path in enumerate(paths) if path in indexed.tables]
    tables = [paths[number] for number in numbers]
    columns = indexed.read(tables, declared) if tables else None
    if columns is None:
        return None
    values, texts, counts = columns
    sources = np.array([_source(table) for table in tables], dtype=np.object_)
    rows = Repeats(values, {**texts, SOURCE: np.repeat(sources, counts)}, tuple(declared.values()))
    return (rows, np.repeat(np.array(numbers), counts)) if _is_valid(rows, declared) else None


def typed_tables(
    tables: Iterable[tuple[Path, bytes]], declared: Mapping[str, Column]
) -> Iterator[tuple[Mapping[str, parsing.ArrowColumn], list[tuple[Path, int]]]]:
    """Yield the columns of many tables as Arrow columns, some tens of megabytes at a time.

    Args:
        tables: Tables and their bytes.
        declared: The columns of all tables.

    Yields:
        The columns, and the tables with their numbers of rows, in the order of the rows. The number is -1 for a table
        that is invalid or must be read line by line.
    """
    batches: dict[bytes, _Batch] = {}
    for number, (path, content) in enumerate(tables):
        header, _, body = content.partition(b"\n")
        try:
            names = _header(path, header)
            _check_line_end(path, body)
        except FieldkitError:
            yield {}, [(path, -1)]
            continue
        batch = batches.setdefault(header, _Batch(header, names))
        batch.add(number, path, body)
        if batch.size >= _BATCH_BYTES:
            yield from batches.pop(header).typed(declared)
    for batch in batches.values():
        yield from batch.typed(declared)


_UNDECLARED: Final = "No declaration: the unchanged text of the table."


def undeclared(name: str) -> Column:
    """Return a text column for a column of a table that has no declaration."""
    return Column(name, "text", _UNDECLARED)


def is_undeclared(column: Column) -> bool:
    """Return True if a column has no declaration."""
    return column.meaning == _UNDECLARED


def names(path: Path) -> tuple[str, ...]:
    """Return the names of a table's columns.

    Raises:
        ConfigurationError: The file cannot be read.
        EvidenceError: For the same reasons as `datasets.names`.
    """
    if path.is_dir():
        from fieldkit.analysis import datasets  # noqa: PLC0415 (imports pandas if it is installed)

        return datasets.names(path)
    with _readable(path), path.open("rb") as file:
        return header_names(file.readline(_MAX_HEADER_BYTES))


@dataclass
class _Batch:
    """Tables with the same header.

    Attributes:
        header: The header line, without its line end.
        names: Names of the columns.
        numbers: Index of each table in the order of all tables.
        paths: Path of each table.
        bodies: Lines of each table without the header.
        size: Total size of the bodies in bytes.
    """

    header: bytes
    names: tuple[str, ...]
    numbers: list[int] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    bodies: list[bytes] = field(default_factory=list)
    size: int = 0

    def add(self, number: int, path: Path, body: bytes) -> None:
        self.numbers.append(number)
        self.paths.append(path)
        self.bodies.append(body)
        self.size += len(body)

    def parse(self, declared: Mapping[str, Column]) -> tuple[Repeats, list[int]]:
        """Return the rows of all tables, and the number of rows of each table."""
        counts = [body.count(b"\n") for body in self.bodies]
        try:
            rows = parse_rows(self.names, b"".join(self.bodies), declared)
        except ValueError:
            rows = None
        if rows is None or len(rows) != sum(counts) or not _is_valid(rows, declared):
            tables = [
                self._parse_single(path, body, declared) for path, body in zip(self.paths, self.bodies, strict=True)
            ]
            rows, counts = _concatenated(tables), [len(table) for table in tables]
        sources = np.array([_source(path) for path in self.paths], dtype=np.object_)
        return replace(rows, texts={**rows.texts, SOURCE: np.repeat(sources, counts)}), counts

    def typed(
        self, declared: Mapping[str, Column]
    ) -> Iterator[tuple[Mapping[str, parsing.ArrowColumn], list[tuple[Path, int]]]]:
        """Yield the items of `typed_tables`: one item for all tables, or one item per table if a table is invalid."""
        present = {name: column for name, column in declared.items() if name in self.names}
        counts = [body.count(b"\n") for body in self.bodies]
        columns = _typed(self.names, b"".join(self.bodies), present, sum(counts))
        if columns is not None:
            yield columns, list(zip(self.paths, counts, strict=True))
            return
        for path, body, rows in zip(self.paths, self.bodies, counts, strict=True):
            columns = _typed(self.names, body, present, rows)
            yield (columns or {}), [(path, -1 if columns is None else rows)]

    def _parse_single(self, path: Path, body: bytes, declared: Mapping[str, Column]) -> Repeats:
        """Return the rows of one table, or raise the error of its first invalid line."""
        if (error := table_errors.first_problem(str(path), self.header + b"\n" + body, declared)) is not None:
            raise error
        try:
            return parse_rows(self.names, body, declared)
        except ValueError as error:
            raise EvidenceError(str(error), where=str(path), remedy="correct the file") from error


def _typed(
    names: Sequence[str], body: bytes, declared: Mapping[str, Column], line_count: int
) -> Mapping[str, parsing.ArrowColumn] | None:
    """Return the Arrow columns of lines, or None if a value is invalid or the lines are not one row each."""
    try:
        columns, row_count = parsing.csv_columns(names, body, declared)
        values, texts = parsing.arrow_columns(columns, declared, row_count)
    except ValueError:
        return None
    is_valid = row_count == line_count and _is_valid(Repeats(values, texts, tuple(declared.values())), declared)
    return columns if is_valid else None


def _read_dataset(path: Path, declared: Mapping[str, Column]) -> Repeats:
    """Return the rows of a dataset of Parquet files.

    Raises the same errors as `datasets.read`, and an error if a value is not possible.
    """
    from fieldkit.analysis import datasets  # noqa: PLC0415 (imports pandas if it is installed)

    numbers, texts, rows = datasets.read(path, declared)
    table = Repeats(numbers, texts, tuple(declared.values()))
    if not _is_valid(table, declared):
        raise EvidenceError("it has impossible values", where=str(path), remedy="run the command of the sweep again")
    return replace(table, texts={**texts, SOURCE: np.full(rows, _source(path), np.object_)})


def _read_large(path: Path, declared: Mapping[str, Column]) -> Repeats | None:
    """Return the rows of a large table, which is read in blocks, or None for a small or invalid table.

    Raises the same errors as `_header` if the header is invalid.
    """
    with _readable(path):
        if path.stat().st_size < 2 * _BATCH_BYTES:
            return None
        with path.open("rb") as file:
            names = _header(path, file.readline(_MAX_HEADER_BYTES).removesuffix(b"\n"))
            parts = []
            while block := file.read(_BATCH_BYTES) + file.readline():
                try:
                    rows = parse_rows(names, block, declared)
                except ValueError:
                    return None
                if len(rows) != block.count(b"\n") or not _is_valid(rows, declared):
                    return None
                parts.append(rows)
    table = _concatenated(parts)
    return replace(table, texts={**table.texts, SOURCE: np.full(len(table), _source(path), np.object_)})


def _is_valid(rows: Repeats, declared: Mapping[str, Column]) -> bool:
    """Return True if all rows have a known schema version, a final status, and possible and consistent numbers."""
    return (
        not (rows.numbers["schema_version"] > SCHEMA_VERSION).any()
        and set(FINAL_STATUSES).issuperset(rows.texts["status"])
        and all(table_errors.are_possible(column, declared[name]) for name, column in rows.numbers.items())
        and table_errors.contradiction(rows.numbers, rows.quantities) is None
    )


def _source(path: Path) -> str:
    """Return the folder of a `trial.csv` or of a dataset; for other tables, the path itself."""
    return str(path.parent if path.name == "trial.csv" or path.is_dir() else path)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert an OSError of the body to a ConfigurationError that names the table."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"cannot be read: {error.strerror}", where=str(path), remedy=shell_command("ls", "-l", path)
        ) from error


def _split(path: Path, content: Callable[[Path], bytes]) -> tuple[bytes, bytes]:
    """Return the header line of a table without its line end, and the lines below it."""
    with _readable(path):
        header, _, body = content(path).partition(b"\n")
    return header, body


def _check_line_end(path: Path, body: bytes) -> None:
    """Check that the last line of a table ends with a line feed: the last number of a truncated line can lack digits.

    Raises:
        EvidenceError: The line feed is missing.
    """
    if body and not body.endswith(b"\n"):
        rebuild = shell_command("fieldkit", "rebuild", path.parent if path.name == "trial.csv" else "TRIAL")
        raise EvidenceError(
            "the last line has no line feed: the table may be truncated",
            where=f"{path}:{1 + len(body.splitlines())}",
            remedy=f"create the file again: {rebuild}; or add the line feed if the line is complete",
        )


def _header(path: Path, header: bytes) -> tuple[str, ...]:
    """Return the names of the columns in a header.

    Raises:
        ConfigurationError: The header is not the header of a table of repeats.
    """
    names = header_names(header)
    missing = [name for name in IDENTITY if name not in names]
    duplicates = sorted(name for name, count in Counter(names).items() if name and count > 1)
    if missing or duplicates:
        reason = (
            f"it lacks {', '.join(missing)}" if missing else f"it has more than one column {', '.join(duplicates)}"
        )
        remedy = "name the folder of a trial or its trial.csv; its columns: fieldkit columns"
        for mark, (problem, correct_format) in _SPREADSHEET_MARKS.items():
            if missing and mark in header.replace(b'"', b""):
                reason, remedy = (
                    problem,
                    f"save it again {correct_format}, or name the trial.csv in the trial's folder",
                )
        raise ConfigurationError(f"this is not a table of repeats: {reason}", where=str(path), remedy=remedy)
    return names


def _concatenated(parts: Sequence[Repeats]) -> Repeats:
    """Return the rows of all parts. To save memory, the columns of the parts are freed after they were joined."""
    numbers, texts = ([dict(getattr(part, kind)) for part in parts] for kind in ("numbers", "texts"))
    names, words, columns = list(numbers[0]), list(texts[0]), parts[0].columns
    return Repeats(
        {name: np.concatenate([part.pop(name) for part in numbers]) for name in names},
        {name: np.concatenate([part.pop(name) for part in texts]) for name in words},
        columns,
    )
