"""Conversion of CSV lines to columns by pyarrow. If it fails, the lines are read sequentially to find the error."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from itertools import count
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import ArrayLike, NDArray

from fieldkit.analysis.quantities import Quantity, quantities
from fieldkit.core.columns import MISSING, SCHEMA_VERSION, Column, Kind
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError
from fieldkit.core.model import ENDED
from fieldkit.core.text import unescape_formula

Numbers = NDArray[np.float64]
Texts = NDArray[np.object_]
ArrowColumn = pa.ChunkedArray

_MAX_SHOWN: Final = 40
_TOLERANCE: Final = 1e-6  # larger than the rounding errors of numbers in a table
_REMEDY: Final = "correct the line, or create the file again: fieldkit rebuild TRIAL"
_SPREADSHEET_REMEDY: Final = (
    "a spreadsheet has removed digits: name the trial.csv in the trial's folder, or create it again: "
    "fieldkit rebuild TRIAL; in a spreadsheet, open this column as text"
)


def columns(
    names: Sequence[str], body: bytes, declared: Mapping[str, Column]
) -> tuple[dict[str, Numbers], dict[str, Texts], int]:
    """Return columns of numbers and of texts, as in `repeats.Repeats`, and the number of rows.

    Args:
        names: All columns of the table, in order.
        body: Its lines without the header, each with its line end.
        declared: The requested columns; columns that the table does not have are missing in all rows.

    Raises:
        ValueError: A line or a value is invalid.
    """
    by_name, rows = csv_columns(names, body, declared)
    return *arrow_columns(by_name, declared, rows), rows


def csv_columns(
    names: Sequence[str], body: bytes, declared: Mapping[str, Column]
) -> tuple[Mapping[str, pa.ChunkedArray], int]:
    """Return the columns of a table that are declared, with the types of `arrow_type`, and the number of rows.

    Arguments and errors as for `columns`.
    """
    present = [name for name in declared if name in names]
    if not body or not present:
        return {}, 0
    table = pa.csv.read_csv(
        pa.BufferReader(body),
        read_options=pa.csv.ReadOptions(column_names=names, block_size=max(len(body) // 8, 1 << 20)),
        convert_options=pa.csv.ConvertOptions(
            column_types={name: arrow_type(declared[name]) for name in present},
            include_columns=present,
            null_values=MISSING,
            strings_can_be_null=False,
        ),
    )
    return dict(zip(present, table.columns, strict=True)), len(table)


def arrow_columns(
    by_name: Mapping[str, pa.ChunkedArray], declared: Mapping[str, Column], rows: int
) -> tuple[dict[str, Numbers], dict[str, Texts]]:
    """Return columns of numbers and of texts, as in `repeats.Repeats`; missing columns are missing in all rows.

    Args:
        by_name: Columns of Arrow, of the types of `arrow_type`.
        declared: The requested columns.
        rows: Number of rows.
    """
    numbers: dict[str, Numbers] = {}
    texts: dict[str, Texts] = {}
    for name, declaration in declared.items():
        column = by_name.get(name)
        if declaration.type is str:
            texts[name] = np.full(rows, "", np.object_) if column is None else _texts(column)
        else:
            numbers[name] = (
                np.asarray(np.full(rows, np.nan, _numpy_type(declaration))) if column is None else _numbers(column)
            )
    return numbers, texts


def codes(column: Texts) -> NDArray[np.int64]:
    """Return the index of the first row with an equal text, for each row of a column."""
    first: dict[str, int] = {}
    return np.fromiter(map(first.setdefault, column, count()), np.int64, len(column))


def are_possible(values: Numbers, column: Column) -> bool:
    """Return True if all values of a column are possible or missing; same rule as `Column.invalid_value_reason`."""
    present = values[~np.isnan(values)]
    low, high = column.possible if column.type is not bool else (0, 1)
    fits = (present >= low) & (present <= high)
    return bool((fits & (present == np.floor(present))).all() if column.type is int else fits.all())


def contradiction(numbers: Mapping[str, ArrayLike], quantities: Iterable[Quantity]) -> Quantity | None:
    """Return a counted quantity whose share contradicts its counts; None if there is no contradiction.

    Args:
        numbers: Columns, or the numbers of one row; NaN if missing. A share is compared only if both counts exist.
        quantities: The quantities to check.
    """
    for quantity in quantities:
        if quantity.kind is Kind.COUNTED and numbers.keys() >= set(quantity.columns):
            share, arrived, sent = (np.asarray(numbers[name], dtype=np.float64) for name in quantity.columns)
            is_complete = np.isfinite(share) & np.isfinite(arrived) & np.isfinite(sent)
            expected = 1 - arrived / np.where(sent > 0, sent, np.nan)
            if (is_complete & ~np.isclose(share, expected, rtol=_TOLERANCE, atol=_TOLERANCE)).any():
                return quantity
    return None


def first_problem(where: str, content: bytes, declared: Mapping[str, Column]) -> FieldkitError | None:
    """Return the error of the first invalid line; None if all lines are valid.

    Args:
        where: The file, for messages.
        content: Its bytes.
        declared: The columns that must be valid.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        return EvidenceError("this line is not UTF-8", where=f"{where}:{line}", remedy=_REMEDY)
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        names = next(reader)
        for row in reader:
            problem = row and _explain_row(f"{where}:{reader.line_num}", names, row, declared)
            if problem:
                return problem
    except csv.Error as error:
        return EvidenceError(f"this is not CSV: {error}", where=f"{where}:{reader.line_num}", remedy=_REMEDY)
    return None


def arrow_type(column: Column) -> pa.DataType:
    """Return the Arrow type by which a column is read."""
    if column.type is str:
        return pa.dictionary(pa.int32(), pa.string())
    return {"bool": pa.bool_(), "ns": pa.int64()}.get(column.unit, pa.float64())


def _numpy_type(column: Column) -> type[np.float64] | type[np.longdouble]:
    """Return the type of a column's numbers; nanoseconds since 1970 need 61 bits, more than a double's precision."""
    return np.longdouble if column.unit == "ns" else np.float64


def _texts(column: pa.ChunkedArray) -> Texts:
    encoded = column.unify_dictionaries().combine_chunks()
    distinct = np.array([*map(unescape_formula, encoded.dictionary.to_pylist()), ""], dtype=np.object_)
    codes = _buffer_values(encoded.indices, np.int32)
    if encoded.null_count:
        codes = np.where(_missing(column), len(distinct) - 1, codes)
    return np.asarray(distinct[codes], dtype=np.object_)


def _numbers(column: pa.ChunkedArray) -> Numbers:
    numbers: Numbers
    if column.type == pa.int64():
        numbers = _buffer_values(column.combine_chunks(), np.int64).astype(np.longdouble)
    else:
        typed = column.cast(pa.uint8()) if column.type == pa.bool_() else column
        numbers = _buffer_values(typed.cast(pa.float64()).combine_chunks(), np.float64).copy()
    if column.null_count:
        numbers[_missing(column)] = np.nan
    return numbers


def _missing(column: pa.ChunkedArray) -> NDArray[np.bool_]:
    return np.asarray(_buffer_values(column.is_null().cast(pa.uint8()).combine_chunks(), np.uint8) != 0)


def _buffer_values(array: pa.Array, kind: type[np.generic]) -> NDArray[Any]:
    """Return the value buffer of an Arrow array without copying; missing values are arbitrary.

    `to_numpy` would import pandas if that is installed, which takes longer than reading a table.
    """
    _, values = array.buffers()
    return np.frombuffer(values, kind, len(array), array.offset * np.dtype(kind).itemsize)


def _explain_row(
    where: str, names: Sequence[str], row: Sequence[str], declared: Mapping[str, Column]
) -> FieldkitError | None:
    if len(row) != len(names):
        return EvidenceError(f"{len(row)} cells in a table of {len(names)} columns", where=where, remedy=_REMEDY)
    cells = dict(zip(names, row, strict=True))
    for name, column in declared.items():
        value = cells.get(name, "")
        if (problem := column.invalid_value_reason(value)) is not None:
            remedy = _SPREADSHEET_REMEDY if column.unit == "ns" and "e" in value.lower() else _REMEDY
            return EvidenceError(f"{name} is {quoted_cell(value)}, {problem}", where=where, remedy=remedy)
    numeric = (name for name, column in declared.items() if column.type in {int, float})
    numbers = {name: float(cells.get(name) or "nan") for name in numeric}
    if (quantity := contradiction(numbers, quantities(declared.values()))) is not None:
        share, arrived, sent = (cells[name] for name in quantity.columns)
        message = f"{quantity.name} is {share}, but {quantity.arrived} is {arrived} of {sent}"
        return EvidenceError(message, where=where, remedy=_REMEDY)
    if cells["schema_version"] not in MISSING and float(cells["schema_version"]) > SCHEMA_VERSION:
        return _newer_schema_error(where, float(cells["schema_version"]))
    if cells["status"] not in ENDED:
        possible = ", ".join(sorted(ENDED))
        return EvidenceError(
            f"status is {quoted_cell(cells['status'])}, not one of: {possible}", where=where, remedy=_REMEDY
        )
    return None


def quoted_cell(text: str) -> str:
    """Return a cell of a table in quotes, shortened for a message."""
    return repr(text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}...")


def _newer_schema_error(where: str, version: float) -> FieldkitError:
    """Return the error of a table that a newer fieldkit wrote."""
    return ConfigurationError(
        f"written by a newer fieldkit: its schema is {version:.0f}, this version reads up to {SCHEMA_VERSION}",
        where=where,
        remedy="upgrade fieldkit",
    )
