"""Attempts of repeats as columns: the contents of trial.csv of one trial or of thousands."""

import csv
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis import parsing
from fieldkit.analysis.parsing import Numbers, Texts
from fieldkit.analysis.quantities import Quantity, quantities, word_columns
from fieldkit.core.columns import SCHEMA_VERSION, Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, did_you_mean, shell_command
from fieldkit.core.model import ENDED, Protocol, RepeatId, Status
from fieldkit.core.text import unescape_formula

Key = tuple[str | float | None, ...]
"""Values of some columns in one row; a missing text is empty, a missing number None."""

SOURCE: Final = "source"
"""The column that `read` adds."""
IDENTITY: Final = ("schema_version", "trial", "protocol", "repeat", "attempt", "status")
"""Columns that a table of repeats must have."""

_SPREADSHEET_MARKS: Final = {
    b"schema_version;": ("its cells are separated by semicolons", "with commas, and with points in numbers"),
    b"schema_version\t": ("its cells are separated by tabs", "with commas"),
    b"s\x00c\x00h\x00e\x00m\x00a\x00": ("its encoding is UTF-16", "as UTF-8"),
}
"""Start of a header that a spreadsheet wrote in another format; the problem, and how to save the file instead."""

_BATCH_BYTES: Final = 1 << 25
_MAX_HEADER_BYTES: Final = 1 << 20


@dataclass(frozen=True, eq=False)
class Repeats:
    """Attempts of repeats, valid or not, as one numpy column per column of trial.csv.

    Attributes:
        numbers: Float columns of shape (n,), NaN if missing; a bool is 0 or 1. Times in ns are long doubles.
        texts: Columns of str, shape (n,), empty if missing; `source` is the trial's folder or the CSV file of a row,
            empty for rows that were not read from a file.
        columns: Declarations of the columns, without `source`.
    """

    numbers: Mapping[str, Numbers]
    texts: Mapping[str, Texts]
    columns: tuple[Column, ...]

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:
        """The quantities whose columns exist, in the order of tables."""
        all_quantities = quantities(self.columns)
        return tuple(quantity for quantity in all_quantities if self.numbers.keys() >= set(quantity.columns))

    @cached_property
    def word_columns(self) -> tuple[Column, ...]:
        """The columns whose words are counted, in order."""
        return tuple(column for column in word_columns(self.columns) if column.name in self.texts)

    def __len__(self) -> int:
        return len(next(iter(self.texts.values())))

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Self:
        """Return the rows of a mask, or the rows with these indices in their order."""
        return type(self)(
            {name: column[chosen] for name, column in self.numbers.items()},
            {name: column[chosen] for name, column in self.texts.items()},
            self.columns,
        )

    def column(self, name: str) -> list[str | float | None]:
        """Return the values of a column; a missing number is None."""
        if name in self.texts:
            return list(self.texts[name])
        numbers, missing = self.numbers[name], np.isnan(self.numbers[name])
        exact = np.where(missing, 0, numbers).astype(np.int64) if numbers.dtype == np.longdouble else numbers
        values = exact.astype(np.object_)
        values[missing] = None
        return list(values)

    def observed(self, quantity: Quantity) -> tuple[Numbers, NDArray[np.bool_]]:
        """Return the values of a quantity, NaN if missing, and a mask of the rows in which they are lower bounds."""
        values = self.numbers[quantity.name]
        bounds = self.numbers.get(quantity.at_least or "")
        if bounds is None:
            return values, np.zeros(len(values), np.bool_)
        censored = np.isnan(values) & np.isfinite(bounds)
        return np.where(censored, bounds, values), censored

    def keys(self, names: Sequence[str]) -> list[Key]:
        """Return the values of the columns `names` for each row."""
        return list(zip(*map(self.column, names), strict=True)) if names else [()] * len(self)

    def codes(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return a number per row, from 0, which is equal for rows with equal values in the columns `names`."""
        codes = np.zeros(len(self), np.int64)
        for name in names:
            texts = self.texts.get(name)
            of_column = (
                np.unique(self.numbers[name], return_inverse=True)[1] if texts is None else parsing.codes(texts)
            )
            codes = np.unique(codes * (of_column.max(initial=0) + 1) + of_column, return_inverse=True)[1]
        return codes

    def groups(self, names: Sequence[str]) -> dict[Key, NDArray[np.int64]]:
        """Return the indices of the rows by key; keys and rows are in the order of the rows."""
        by_key: dict[Key, list[int]] = {}
        for row, key in enumerate(self.keys(names)):
            by_key.setdefault(key, []).append(row)
        return {key: np.array(rows) for key, rows in by_key.items()}

    def name(self, row: int) -> str:
        """Return the name of the repeat in a row: `udp-07`."""
        number = self.numbers["repeat"][row]
        return f"{self.texts['protocol'][row]}-{'??' if np.isnan(number) else f'{number:02.0f}'}"

    def folder(self, row: int) -> str | None:
        """Return the name of the folder of the attempt in a row: `udp-07`; None if the row has invalid values."""
        texts, numbers = self.texts, self.numbers
        try:
            repeat = RepeatId(Protocol(texts["protocol"][row]), int(numbers["repeat"][row]))
            return repeat.folder(Status(texts["status"][row]), int(numbers["attempt"][row]))
        except ValueError:  # the table was edited
            return None

    @cached_property
    def _by_folder(self) -> Mapping[str, Sequence[int]]:
        """Rows by the name of the attempt's folder, and by `TRIAL/FOLDER`."""
        rows: dict[str, list[int]] = {}
        for row, trial in enumerate(self.texts["trial"]):
            if folder := self.folder(row):
                for name in (folder, f"{trial}/{folder}"):
                    rows.setdefault(name, []).append(row)
        return rows

    def row(self, attempt: str) -> int:
        """Return the row of an attempt.

        Args:
            attempt: Name of its folder, `udp-07`, with the prefix `TRIAL/` if several trials have this folder.

        Raises:
            ConfigurationError: There is no such attempt, or there are several.
        """
        rows = self._by_folder.get(attempt, ())
        if not rows:
            remedy = "name a folder below repeats/ of a trial, for example udp-07"
            raise ConfigurationError(
                f"there is no repeat {attempt!r}", remedy=did_you_mean(attempt, self._by_folder, remedy)
            )
        if len(rows) > 1:
            names = [f"{self.texts['trial'][row]}/{attempt}" for row in rows]
            raise ConfigurationError(
                f"{len(rows)} trials have a repeat {attempt!r}", remedy=f"name one: {', '.join(names[:3])}"
            )
        return rows[0]


def parse(content: bytes, declared: Iterable[Column], where: str = "trial.csv") -> Repeats:
    """Return the rows of a trial.csv; columns that it does not have are missing in all rows.

    Raises:
        EvidenceError: A value is not possible for its column.
    """
    header, _, body = content.partition(b"\n")
    named = _by_name(declared)
    try:
        return _parse(_names(header), body, named)
    except ValueError as error:
        raise parsing.first_problem(where, content, named) or EvidenceError(
            f"its values do not agree with the declarations of its columns: {error}",
            where=where,
            remedy="correct the declarations under columns: in trial.yaml",
        ) from error


def _by_name(declared: Iterable[Column]) -> dict[str, Column]:
    return {column.name: column for column in declared}


def read(
    paths: Iterable[Path],
    declared: Iterable[Column],
    columns: Collection[str] | None = None,
    content: Callable[[Path], bytes] = Path.read_bytes,
) -> Repeats:
    """Return the rows of many tables, in the order of `paths`; columns that a table does not have are missing.

    Tables with the same header are parsed together, some tens of megabytes at a time, because the start of pyarrow's
    parser takes longer than parsing the 40 rows of a trial.

    Args:
        paths: CSV files with the columns of trial.csv, of any schema version up to that of this version of fieldkit.
        declared: The columns of trial.csv.
        columns: Names of the columns to read, None for all; those of `IDENTITY` are always read.
        content: Function that reads the bytes of a table.

    Raises:
        ConfigurationError: A file cannot be read, is not a table of repeats, or was written by a newer fieldkit.
        EvidenceError: A line is invalid.
    """
    requested = None if columns is None else {*columns, *IDENTITY}
    named = {name: column for name, column in _by_name(declared).items() if requested is None or name in requested}
    batches: dict[bytes, _Batch] = {}
    parts: list[Repeats] = []
    order: list[NDArray[np.int64]] = []

    def parse_batch(batch: _Batch) -> None:
        part, counts = batch.parse(named)
        parts.append(part)
        order.append(np.repeat(batch.numbers, counts))

    for number, path in enumerate(paths):
        if path.is_dir():
            dataset = _read_dataset(path, named)
            parts.append(dataset)
            order.append(np.full(len(dataset), number))
            continue
        if content == Path.read_bytes and (large := _read_large(path, named)) is not None:
            parts.append(large)
            order.append(np.full(len(large), number))
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
    rows = _concatenated(parts or [_parse((), b"", named)])
    numbers = np.concatenate(order) if order else np.empty(0, np.int64)
    return rows if (np.diff(numbers) >= 0).all() else rows.where(np.argsort(numbers, kind="stable"))


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
        EvidenceError: As for `datasets.names`.
    """
    if path.is_dir():
        from fieldkit.analysis import datasets  # noqa: PLC0415 (as above)

        return datasets.names(path)
    with _readable(path), path.open("rb") as file:
        return _names(file.readline(_MAX_HEADER_BYTES))


@dataclass
class _Batch:
    """Tables with the same header."""

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
            rows = _parse(self.names, b"".join(self.bodies), declared)
        except ValueError:
            rows = None
        if rows is None or len(rows) != sum(counts) or not _is_valid(rows, declared):
            tables = [
                self._parse_single(path, body, declared) for path, body in zip(self.paths, self.bodies, strict=True)
            ]
            rows, counts = _concatenated(tables), [len(table) for table in tables]
        sources = np.array([_source(path) for path in self.paths], dtype=np.object_)
        return replace(rows, texts={**rows.texts, SOURCE: np.repeat(sources, counts)}), counts

    def _parse_single(self, path: Path, body: bytes, declared: Mapping[str, Column]) -> Repeats:
        if (error := parsing.first_problem(str(path), self.header + b"\n" + body, declared)) is not None:
            raise error
        try:
            return _parse(self.names, body, declared)
        except ValueError as error:
            raise EvidenceError(str(error), where=str(path), remedy="correct the file") from error


def _read_dataset(path: Path, declared: Mapping[str, Column]) -> Repeats:
    """Return the rows of a dataset of Parquet files; errors as `datasets.read`, or if a value is not possible."""
    from fieldkit.analysis import datasets  # noqa: PLC0415 (imports pandas if it is installed)

    numbers, texts, rows = datasets.read(path, declared)
    table = Repeats(numbers, texts, tuple(declared.values()))
    if not _is_valid(table, declared):
        raise EvidenceError("it has impossible values", where=str(path), remedy="run the command of the sweep again")
    return replace(table, texts={**texts, SOURCE: np.full(rows, _source(path), np.object_)})


def _read_large(path: Path, declared: Mapping[str, Column]) -> Repeats | None:
    """Return the rows of a large table, read in blocks; None for a small or an invalid table.

    Raises errors of the header as `_header`.
    """
    with _readable(path):
        if path.stat().st_size < 2 * _BATCH_BYTES:
            return None
        with path.open("rb") as file:
            names = _header(path, file.readline(_MAX_HEADER_BYTES).removesuffix(b"\n"))
            parts = []
            while block := file.read(_BATCH_BYTES) + file.readline():
                try:
                    rows = _parse(names, block, declared)
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
        and set(ENDED).issuperset(rows.texts["status"])
        and all(parsing.are_possible(column, declared[name]) for name, column in rows.numbers.items())
        and parsing.contradiction(rows.numbers, rows.quantities) is None
    )


def _source(path: Path) -> str:
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
    """Check that a table's last line has a line feed; the last number of a truncated line can lack digits.

    Raises:
        EvidenceError: The line feed is missing.
    """
    if body and not body.endswith(b"\n"):
        raise EvidenceError(
            "the last line has no line feed: the table may be truncated",
            where=f"{path}:{1 + len(body.splitlines())}",
            remedy="create the file again: fieldkit rebuild TRIAL; or add the line feed if the line is complete",
        )


def _names(header: bytes) -> tuple[str, ...]:
    """Return the names in a header line; an empty tuple if a name exceeds the 128 kB limit of the csv module."""
    try:
        return tuple(map(unescape_formula, next(csv.reader([header.decode("utf-8-sig", errors="replace")]), ())))
    except csv.Error:
        return ()


def _header(path: Path, header: bytes) -> tuple[str, ...]:
    names = _names(header)
    missing = [name for name in IDENTITY if name not in names]
    duplicates = sorted(name for name, count in Counter(names).items() if name and count > 1)
    if missing or duplicates:
        reason = (
            f"it lacks {', '.join(missing)}" if missing else f"it has more than one column {', '.join(duplicates)}"
        )
        remedy = "name the folder of a trial or its trial.csv; its columns: fieldkit columns"
        for mark, (problem, instead) in _SPREADSHEET_MARKS.items():
            if missing and mark in header.replace(b'"', b""):
                reason, remedy = problem, f"save it again {instead}, or name the trial.csv in the trial's folder"
        raise ConfigurationError(f"this is not a table of repeats: {reason}", where=str(path), remedy=remedy)
    return names


def _parse(names: Sequence[str], body: bytes, declared: Mapping[str, Column]) -> Repeats:
    numbers, texts, rows = parsing.columns(names, body, declared)
    return Repeats(numbers, {**texts, SOURCE: np.full(rows, "", np.object_)}, tuple(declared.values()))


def _concatenated(parts: Sequence[Repeats]) -> Repeats:
    """Return the rows of all parts; each column of the parts is freed after it was joined, to save memory."""
    numbers, texts = ([dict(getattr(part, kind)) for part in parts] for kind in ("numbers", "texts"))
    names, words, columns = list(numbers[0]), list(texts[0]), parts[0].columns
    return Repeats(
        {name: np.concatenate([part.pop(name) for part in numbers]) for name in names},
        {name: np.concatenate([part.pop(name) for part in texts]) for name in words},
        columns,
    )
