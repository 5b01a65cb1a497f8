"""Attempts of repeats as columns: the rows of one or several trial.csv."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis import parsing
from fieldkit.analysis.parsing import Numbers, Texts
from fieldkit.analysis.quantities import Quantity, quantities, word_columns
from fieldkit.core.columns import Column
from fieldkit.core.errors import ConfigurationError, EvidenceError, did_you_mean
from fieldkit.core.model import Protocol, RepeatId, Status
from fieldkit.core.text import unescape_formula

Key = tuple[str | float | None, ...]
"""Values of some columns in one row; a missing text is empty, a missing number None."""

SOURCE: Final = "source"
"""Name of the column that `table_files.read` adds."""


@dataclass(frozen=True, eq=False)
class Repeats:
    """Attempts of repeats, valid or not, as one numpy column per column of trial.csv.

    Attributes:
        numbers: Columns of numbers, shape (n,); missing numbers are NaN, a bool is 0 or 1, times in ns are long
            doubles.
        texts: Columns of texts, shape (n,); missing texts are empty. `source` is the trial's folder or the CSV file
            of a row, and empty for rows that were not read from a file.
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
        """The text columns whose values are counted, in the order in which tables list them."""
        return tuple(column for column in word_columns(self.columns) if column.name in self.texts)

    def __len__(self) -> int:
        return len(next(iter(self.texts.values())))

    def where(self, selection: NDArray[np.bool_] | NDArray[np.int64]) -> Self:
        """Return the rows that a mask selects, or the rows at the indices of an array, in its order."""
        return type(self)(
            {name: column[selection] for name, column in self.numbers.items()},
            {name: column[selection] for name, column in self.texts.items()},
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
        """Return the values of a quantity, NaN if missing, and a mask of the values that are lower bounds."""
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
        """Return a number for each row, from 0. Rows with equal values in the columns `names` have equal numbers."""
        codes = np.zeros(len(self), np.int64)
        for name in names:
            texts = self.texts.get(name)
            column_codes = (
                np.unique(self.numbers[name], return_inverse=True)[1] if texts is None else parsing.codes(texts)
            )
            codes = np.unique(codes * (column_codes.max(initial=0) + 1) + column_codes, return_inverse=True)[1]
        return codes

    def groups(self, names: Sequence[str]) -> dict[Key, NDArray[np.int64]]:
        """Return the indices of the rows by key. Keys and indices are in the order of the rows."""
        rows_by_key: dict[Key, list[int]] = {}
        for row, key in enumerate(self.keys(names)):
            rows_by_key.setdefault(key, []).append(row)
        return {key: np.array(rows) for key, rows in rows_by_key.items()}

    def name(self, row: int) -> str:
        """Return the name of the repeat in a row, such as `udp-07`."""
        number = self.numbers["repeat"][row]
        return f"{self.texts['protocol'][row]}-{'??' if np.isnan(number) else f'{number:02.0f}'}"

    def folder(self, row: int) -> str | None:
        """Return the name of the attempt's folder, such as `udp-07`, or None if the row has invalid values."""
        texts, numbers = self.texts, self.numbers
        try:
            repeat = RepeatId(Protocol(texts["protocol"][row]), int(numbers["repeat"][row]))
            return repeat.folder(Status(texts["status"][row]), int(numbers["attempt"][row]))
        except ValueError:  # an edited table can contain invalid values
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
    """Return the rows of a trial.csv. A declared column that is missing in the file has no value in any row.

    Raises:
        EvidenceError: A value is not possible for its column.
    """
    header, _, body = content.partition(b"\n")
    columns_by_name = by_name(declared)
    try:
        return parse_rows(header_names(header), body, columns_by_name)
    except ValueError as error:
        from fieldkit.analysis.table_errors import first_problem  # noqa: PLC0415 (needed only for tables with errors)

        raise first_problem(where, content, columns_by_name) or EvidenceError(
            f"its values do not agree with the declarations of its columns: {error}",
            where=where,
            remedy="correct the declarations under columns: in trial.yaml",
        ) from error


def by_name(declared: Iterable[Column]) -> dict[str, Column]:
    """Return the declarations by the names of their columns."""
    return {column.name: column for column in declared}


@lru_cache(maxsize=16)  # because thousands of tables have the same header
def header_names(header: bytes) -> tuple[str, ...]:
    """Return the names in a header line; an empty tuple if a name exceeds the 128 kB limit of the csv module."""
    try:
        return tuple(map(unescape_formula, next(csv.reader([header.decode("utf-8-sig", errors="replace")]), ())))
    except csv.Error:
        return ()


def parse_rows(names: Sequence[str], body: bytes, declared: Mapping[str, Column]) -> Repeats:
    """Return the rows of the lines below a header.

    Args:
        names: Names of the columns, from the header.
        body: The lines.
        declared: Declarations of the columns to read, by name.

    Raises:
        ValueError: A value is not possible for its column.
    """
    numbers, texts, rows = parsing.columns(names, body, declared)
    return Repeats(numbers, {**texts, SOURCE: np.full(rows, "", np.object_)}, tuple(declared.values()))
