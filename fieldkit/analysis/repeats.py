"""Attempts at repeats as columns: what trial.csv holds, of one trial or of thousands."""

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
from fieldkit.analysis.quantities import Quantity, quantities
from fieldkit.analysis.words import worded
from fieldkit.core.columns import SCHEMA_VERSION, Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, nearest, typed
from fieldkit.core.model import ENDED, Protocol, RepeatId, Status
from fieldkit.core.text import unguarded

Key = tuple[str | float | None, ...]
"""Values of some columns in one row; a missing text is empty, a missing number None."""

SOURCE: Final = "source"
"""The column that `read` adds."""
IDENTITY: Final = ("schema_version", "trial", "protocol", "repeat", "attempt", "status")
"""What a table of repeats must have."""

_SPREADSHEET: Final = {
    b"schema_version;": ("its cells stand apart by semicolons", "with commas, and with points in numbers"),
    b"schema_version\t": ("its cells stand apart by tabs", "with commas"),
    b"s\x00c\x00h\x00e\x00m\x00a\x00": ("its letters are UTF-16", "as UTF-8"),
}
"""Marks of a header that a spreadsheet wrote in its own way: what is wrong, and how to save it instead."""

_BATCH_BYTES: Final = 1 << 25
_MOST_HEADER_BYTES: Final = 1 << 20


@dataclass(frozen=True, eq=False)
class Repeats:
    """Attempts at repeats, valid or not, one numpy column per column of trial.csv.

    Attributes:
        numbers: Float columns of shape (n,), NaN where missing; a bool is 0 or 1. Times in ns are long doubles.
        texts: Columns of str, shape (n,), empty where missing; `source` is the trial's folder or the CSV that a row
            was read from, empty for rows that come from no file.
        columns: What each of them is, but for `source`.
    """

    numbers: Mapping[str, Numbers]
    texts: Mapping[str, Texts]
    columns: tuple[Column, ...]

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:
        """What figures can be made of, in the order in which tables show them."""
        found = quantities(self.columns)
        return tuple(quantity for quantity in found if self.numbers.keys() >= set(quantity.columns))

    @cached_property
    def worded(self) -> tuple[Column, ...]:
        """The columns whose words are counted, in order."""
        return tuple(column for column in worded(self.columns) if column.name in self.texts)

    def __len__(self) -> int:
        return len(next(iter(self.texts.values())))

    def where(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Self:
        """Return the rows of a mask, or those of an index in its order."""
        return type(self)(
            {name: column[chosen] for name, column in self.numbers.items()},
            {name: column[chosen] for name, column in self.texts.items()},
            self.columns,
        )

    def column(self, name: str) -> list[str | float | None]:
        """Return a column, a missing number as None."""
        if name in self.texts:
            return list(self.texts[name])
        numbers, missing = self.numbers[name], np.isnan(self.numbers[name])
        known = np.where(missing, 0, numbers).astype(np.int64) if numbers.dtype == np.longdouble else numbers
        values = known.astype(np.object_)
        values[missing] = None
        return list(values)

    def observed(self, quantity: Quantity) -> tuple[Numbers, NDArray[np.bool_]]:
        """Return a quantity row by row, and in which rows that is only a lower bound; NaN where it is missing."""
        values = self.numbers[quantity.name]
        bounds = self.numbers.get(quantity.at_least or "")
        if bounds is None:
            return values, np.zeros(len(values), np.bool_)
        censored = np.isnan(values) & np.isfinite(bounds)
        return np.where(censored, bounds, values), censored

    def keys(self, names: Sequence[str]) -> list[Key]:
        """Return what the columns `names` hold, row by row."""
        return list(zip(*map(self.column, names), strict=True)) if names else [()] * len(self)

    def codes(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Return a number per row, equal where the columns `names` hold the same, counted from 0."""
        found = np.zeros(len(self), np.int64)
        for name in names:
            texts = self.texts.get(name)
            own = np.unique(self.numbers[name], return_inverse=True)[1] if texts is None else parsing.codes(texts)
            found = np.unique(found * (own.max(initial=0) + 1) + own, return_inverse=True)[1]
        return found

    def groups(self, names: Sequence[str]) -> dict[Key, NDArray[np.int64]]:
        """Return the index of the rows of each key, both in the order of the rows."""
        found: dict[Key, list[int]] = {}
        for row, key in enumerate(self.keys(names)):
            found.setdefault(key, []).append(row)
        return {key: np.array(rows) for key, rows in found.items()}

    def name(self, row: int) -> str:
        """Return what the repeat in a row is called: `udp-07`."""
        number = self.numbers["repeat"][row]
        return f"{self.texts['protocol'][row]}-{'??' if np.isnan(number) else f'{number:02.0f}'}"

    def folder(self, row: int) -> str | None:
        """Return the name of the folder of the attempt in a row: `udp-07`; None where its row names none."""
        texts, numbers = self.texts, self.numbers
        try:
            repeat = RepeatId(Protocol(texts["protocol"][row]), int(numbers["repeat"][row]))
            return repeat.folder(Status(texts["status"][row]), int(numbers["attempt"][row]))
        except ValueError:  # somebody edited the table
            return None

    @cached_property
    def _by_folder(self) -> Mapping[str, Sequence[int]]:
        """Rows by the name of the attempt's folder, and by that behind the name of its trial."""
        found: dict[str, list[int]] = {}
        for row, trial in enumerate(self.texts["trial"]):
            if name := self.folder(row):
                for one in (name, f"{trial}/{name}"):
                    found.setdefault(one, []).append(row)
        return found

    def row(self, attempt: str) -> int:
        """Return the row of an attempt by its folder: `udp-07`, with `TRIAL/` before it where several have one.

        Raises:
            ConfigurationError: There is no such attempt, or there are several.
        """
        rows = self._by_folder.get(attempt, ())
        if not rows:
            remedy = "name a folder below repeats/ of a trial, for example udp-07"
            raise ConfigurationError(
                f"there is no repeat {attempt!r}", remedy=nearest(attempt, self._by_folder, remedy)
            )
        if len(rows) > 1:
            names = [f"{self.texts['trial'][row]}/{attempt}" for row in rows]
            raise ConfigurationError(
                f"{len(rows)} trials have a repeat {attempt!r}", remedy=f"name one: {', '.join(names[:3])}"
            )
        return rows[0]


def parse(content: bytes, declared: Iterable[Column], where: str = "trial.csv") -> Repeats:
    """Return what a trial.csv holds; columns that it lacks are missing throughout.

    Raises:
        EvidenceError: A value is not what its column is declared to hold.
    """
    header, _, body = content.partition(b"\n")
    named = _named(declared)
    try:
        return _parse(_names(header), body, named)
    except ValueError as error:
        raise parsing.first_problem(where, content, named) or EvidenceError(
            f"its values are not what its columns are declared to hold: {error}",
            where=where,
            remedy="correct columns: of trial.yaml, which says what each is",
        ) from error


def _named(declared: Iterable[Column]) -> dict[str, Column]:
    return {column.name: column for column in declared}


def read(
    paths: Iterable[Path],
    declared: Iterable[Column],
    columns: Collection[str] | None = None,
    content: Callable[[Path], bytes] = Path.read_bytes,
) -> Repeats:
    """Return the rows of many tables, in the order of `paths`; columns that a table lacks are missing.

    Tables of one form are parsed together, some tens of megabytes at a time: it takes pyarrow longer to begin than to
    parse the 40 rows of a trial.

    Args:
        paths: CSV files with the columns of trial.csv, of any schema version up to this fieldkit's.
        declared: The columns of trial.csv.
        columns: Which of them to read, None for all; those of `IDENTITY` are read in any case.
        content: How the bytes of a table are had.

    Raises:
        ConfigurationError: A file cannot be read, is no table of repeats, or comes from a newer fieldkit.
        EvidenceError: A line is damaged.
    """
    wanted = None if columns is None else {*columns, *IDENTITY}
    named = {name: column for name, column in _named(declared).items() if wanted is None or name in wanted}
    batches: dict[bytes, _Batch] = {}
    parts: list[Repeats] = []
    order: list[NDArray[np.int64]] = []

    def end(batch: _Batch) -> None:
        part, counts = batch.parse(named)
        parts.append(part)
        order.append(np.repeat(batch.numbers, counts))

    for number, path in enumerate(paths):
        if content == Path.read_bytes and (large := _large(path, named)) is not None:
            parts.append(large)
            order.append(np.full(len(large), number))
            continue
        header, body = _split(path, content)
        if header not in batches:
            batches[header] = _Batch(header, _header(path, header))
        _demand_end(path, body)
        batches[header].add(number, path, body)
        if batches[header].size >= _BATCH_BYTES:
            end(batches.pop(header))
    for batch in batches.values():
        end(batch)
    together = _concatenated(parts or [_parse((), b"", named)])
    numbers = np.concatenate(order) if order else np.empty(0, np.int64)
    return together if (np.diff(numbers) >= 0).all() else together.where(np.argsort(numbers, kind="stable"))


_UNDECLARED: Final = "Nobody declares it: as it stands in the table."


def undeclared(name: str) -> Column:
    """Return a column that a table has and nobody declares: text, as it stands there."""
    return Column(name, "text", _UNDECLARED)


def is_undeclared(column: Column) -> bool:
    """Return whether nobody declares a column."""
    return column.meaning == _UNDECLARED


def names(path: Path) -> tuple[str, ...]:
    """Return the names of a table's columns.

    Raises:
        ConfigurationError: The file cannot be read.
    """
    with _readable(path), path.open("rb") as file:
        return _names(file.readline(_MOST_HEADER_BYTES))


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
        """Return all rows, and how many come from each table."""
        counts = [body.count(b"\n") for body in self.bodies]
        try:
            rows = _parse(self.names, b"".join(self.bodies), declared)
        except ValueError:
            rows = None
        if rows is None or len(rows) != sum(counts) or not _is_sound(rows, declared):
            singly = [self._alone(path, body, declared) for path, body in zip(self.paths, self.bodies, strict=True)]
            rows, counts = _concatenated(singly), [len(one) for one in singly]
        sources = np.array([_source(path) for path in self.paths], dtype=np.object_)
        return replace(rows, texts={**rows.texts, SOURCE: np.repeat(sources, counts)}), counts

    def _alone(self, path: Path, body: bytes, declared: Mapping[str, Column]) -> Repeats:
        if (error := parsing.first_problem(str(path), self.header + b"\n" + body, declared)) is not None:
            raise error
        try:
            return _parse(self.names, body, declared)
        except ValueError as error:
            raise EvidenceError(str(error), where=str(path), remedy="mend the file") from error


def _large(path: Path, declared: Mapping[str, Column]) -> Repeats | None:
    """Return the rows of a large table, which is never in memory whole; None for a small one, or a damaged one.

    Errors of its header as `_header`.
    """
    with _readable(path):
        if path.stat().st_size < 2 * _BATCH_BYTES:
            return None
        with path.open("rb") as file:
            names = _header(path, file.readline(_MOST_HEADER_BYTES).removesuffix(b"\n"))
            parts = []
            while block := file.read(_BATCH_BYTES) + file.readline():
                try:
                    rows = _parse(names, block, declared)
                except ValueError:
                    return None
                if len(rows) != block.count(b"\n") or not _is_sound(rows, declared):
                    return None
                parts.append(rows)
    together = _concatenated(parts)
    return replace(together, texts={**together.texts, SOURCE: np.full(len(together), _source(path), np.object_)})


def _is_sound(rows: Repeats, declared: Mapping[str, Column]) -> bool:
    """Return whether all rows are of this fieldkit's schema or an older one, with an end, and possible numbers."""
    return (
        not (rows.numbers["schema_version"] > SCHEMA_VERSION).any()
        and set(ENDED).issuperset(rows.texts["status"])
        and all(parsing.are_possible(column, declared[name]) for name, column in rows.numbers.items())
        and parsing.contradiction(rows.numbers, rows.quantities) is None
    )


def _source(path: Path) -> str:
    return str(path.parent if path.name == "trial.csv" else path)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Say which table the body could not read."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"cannot be read: {error.strerror}", where=str(path), remedy=typed("ls", "-l", path)
        ) from error


def _split(path: Path, content: Callable[[Path], bytes]) -> tuple[bytes, bytes]:
    """Return the header line of a table and the lines below it, each with its end."""
    with _readable(path):
        header, _, body = content(path).partition(b"\n")
    return header, body


def _demand_end(path: Path, body: bytes) -> None:
    """Demand that a table's last line has an end: of a cut one a number may be left that is a tenth of what it was.

    Raises:
        EvidenceError: It has none.
    """
    if body and not body.endswith(b"\n"):
        raise EvidenceError(
            "the last line has no end: the table may be cut",
            where=f"{path}:{1 + len(body.splitlines())}",
            remedy="make the file again: fieldkit rebuild TRIAL; or end its last line, if that is whole",
        )


def _names(header: bytes) -> tuple[str, ...]:
    """Return the names in a header line, none where one is of more than 128 kB, in whatever this is."""
    try:
        return tuple(map(unguarded, next(csv.reader([header.decode("utf-8-sig", errors="replace")]), ())))
    except csv.Error:
        return ()


def _header(path: Path, header: bytes) -> tuple[str, ...]:
    names = _names(header)
    lacking = [name for name in IDENTITY if name not in names]
    twice = sorted(name for name, times in Counter(names).items() if name and times > 1)
    if lacking or twice:
        what = f"it lacks {', '.join(lacking)}" if lacking else f"{', '.join(twice)} is there twice"
        remedy = "name the folder of a trial or its trial.csv; its columns: fieldkit columns"
        for mark, (said, instead) in _SPREADSHEET.items():
            if lacking and mark in header.replace(b'"', b""):
                what, remedy = said, f"save it anew {instead}, or name the trial's own trial.csv"
        raise ConfigurationError(f"this is no table of repeats: {what}", where=str(path), remedy=remedy)
    return names


def _parse(names: Sequence[str], body: bytes, declared: Mapping[str, Column]) -> Repeats:
    numbers, texts, rows = parsing.columns(names, body, declared)
    return Repeats(numbers, {**texts, SOURCE: np.full(rows, "", np.object_)}, tuple(declared.values()))


def _concatenated(parts: Sequence[Repeats]) -> Repeats:
    """Return the rows of all parts; a column of the parts is freed as soon as it is joined, as large as all are."""
    numbers, texts = ([dict(getattr(part, kind)) for part in parts] for kind in ("numbers", "texts"))
    names, words, columns = list(numbers[0]), list(texts[0]), parts[0].columns
    return Repeats(
        {name: np.concatenate([part.pop(name) for part in numbers]) for name in names},
        {name: np.concatenate([part.pop(name) for part in texts]) for name in words},
        columns,
    )
