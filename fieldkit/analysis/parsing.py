"""Lines of a CSV to columns, by pyarrow; a table that it refuses is read again by line, to tell what is wrong."""

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
from fieldkit.core.text import unguarded

Numbers = NDArray[np.float64]
Texts = NDArray[np.object_]

_SHOWN: Final = 40
_AGREED: Final = 1e-6  # fewer digits than a table has
_REMEDY: Final = "mend the line, or make the file again: fieldkit rebuild TRIAL"
_SHORTENED: Final = (
    "a spreadsheet has cut its digits: name the trial's own trial.csv, or make it again: fieldkit rebuild TRIAL; "
    "in a spreadsheet open this column as text"
)


def columns(
    names: Sequence[str], body: bytes, declared: Mapping[str, Column]
) -> tuple[dict[str, Numbers], dict[str, Texts], int]:
    """Return columns of numbers and of texts, as `repeats.Repeats` has them, and how many rows they have.

    Args:
        names: All columns of the table, in order.
        body: Its lines without the header, each with its end.
        declared: The columns that are wanted; those that the table lacks are missing throughout.

    Raises:
        ValueError: A line or a value is damaged.
    """
    present = [name for name in declared if name in names]
    found: Mapping[str, pa.ChunkedArray] = {}
    rows = 0
    if body and present:
        table = pa.csv.read_csv(
            pa.BufferReader(body),
            read_options=pa.csv.ReadOptions(column_names=names, block_size=max(len(body) // 8, 1 << 20)),
            convert_options=pa.csv.ConvertOptions(
                column_types={name: _type(declared[name]) for name in present},
                include_columns=present,
                null_values=MISSING,
                strings_can_be_null=False,
            ),
        )
        found, rows = dict(zip(present, table.columns, strict=True)), len(table)
    numbers: dict[str, Numbers] = {}
    texts: dict[str, Texts] = {}
    for name, declaration in declared.items():
        column = found.get(name)
        if declaration.type is str:
            texts[name] = np.full(rows, "", np.object_) if column is None else _texts(column)
        else:
            numbers[name] = (
                np.asarray(np.full(rows, np.nan, _width(declaration))) if column is None else _numbers(column)
            )
    return numbers, texts, rows


def codes(column: Texts) -> NDArray[np.int64]:
    """Return a number for each text of a column: the index of the first row with an equal one."""
    first: dict[str, int] = {}
    return np.fromiter(map(first.setdefault, column, count()), np.int64, len(column))


def are_possible(values: Numbers, column: Column) -> bool:
    """Return whether a column holds nothing but what it can, or what is missing; as `Column.problem`."""
    known = values[~np.isnan(values)]
    low, high = column.possible if column.type is not bool else (0, 1)
    fits = (known >= low) & (known <= high)
    return bool((fits & (known == np.floor(known))).all() if column.type is int else fits.all())


def contradiction(numbers: Mapping[str, ArrayLike], quantities: Iterable[Quantity]) -> Quantity | None:
    """Return a counted quantity whose share is not what its counts say; None where there is none.

    Args:
        numbers: Columns, or the numbers of one row; NaN where missing. Where one of three is, nothing is compared.
        quantities: What to look at.
    """
    for quantity in quantities:
        if quantity.kind is Kind.COUNTED and numbers.keys() >= set(quantity.columns):
            share, arrived, sent = (np.asarray(numbers[name], dtype=np.float64) for name in quantity.columns)
            known = np.isfinite(share) & np.isfinite(arrived) & np.isfinite(sent)
            counted = 1 - arrived / np.where(sent > 0, sent, np.nan)
            if (known & ~np.isclose(share, counted, rtol=_AGREED, atol=_AGREED)).any():
                return quantity
    return None


def first_problem(where: str, content: bytes, declared: Mapping[str, Column]) -> FieldkitError | None:
    """Return what is wrong with the first damaged line, None where every line is sound.

    Args:
        where: The file, for messages.
        content: Its bytes.
        declared: The columns that must be readable.
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
            found = row and _explain_row(f"{where}:{reader.line_num}", names, row, declared)
            if found:
                return found
    except csv.Error as error:
        return EvidenceError(f"this is no CSV: {error}", where=f"{where}:{reader.line_num}", remedy=_REMEDY)
    return None


def _type(column: Column) -> pa.DataType:
    if column.type is str:
        return pa.dictionary(pa.int32(), pa.string())
    return {"bool": pa.bool_(), "ns": pa.int64()}.get(column.unit, pa.float64())


def _width(column: Column) -> type[np.float64] | type[np.longdouble]:
    """Return the type of a column's numbers: nanoseconds since 1970 have 61 bits, for which a double has no room."""
    return np.longdouble if column.unit == "ns" else np.float64


def _texts(column: pa.ChunkedArray) -> Texts:
    encoded = column.unify_dictionaries().combine_chunks()
    known = np.array([*map(unguarded, encoded.dictionary.to_pylist()), ""], dtype=np.object_)
    return np.asarray(known[_plain(encoded.indices, np.int32)], dtype=np.object_)


def _numbers(column: pa.ChunkedArray) -> Numbers:
    numbers: Numbers
    if column.type == pa.int64():
        numbers = _plain(column.combine_chunks(), np.int64).astype(np.longdouble)
    else:
        typed = column.cast(pa.uint8()) if column.type == pa.bool_() else column
        numbers = _plain(typed.cast(pa.float64()).combine_chunks(), np.float64).copy()
    if column.null_count:
        numbers[_plain(column.is_null().cast(pa.uint8()).combine_chunks(), np.uint8) != 0] = np.nan
    return numbers


def _plain(array: pa.Array, kind: type[np.generic]) -> NDArray[Any]:
    """Return the values of an array where Arrow keeps them, whatever stands in place of those that are missing.

    `to_numpy` would import pandas where that is installed, which takes longer than all else that reads a table.
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
        if (problem := column.problem(value)) is not None:
            remedy = _SHORTENED if column.unit == "ns" and "e" in value.lower() else _REMEDY
            return EvidenceError(f"{name} is {shown(value)}, {problem}", where=where, remedy=remedy)
    counted = (name for name, column in declared.items() if column.type in {int, float})
    numbers = {name: float(cells.get(name) or "nan") for name in counted}
    if (one := contradiction(numbers, quantities(declared.values()))) is not None:
        share, arrived, sent = (cells[name] for name in one.columns)
        what = f"{one.name} is {share}, but {one.arrived} is {arrived} of {sent}"
        return EvidenceError(what, where=where, remedy=_REMEDY)
    if cells["schema_version"] not in MISSING and float(cells["schema_version"]) > SCHEMA_VERSION:
        return _newer(where, float(cells["schema_version"]))
    if cells["status"] not in ENDED:
        known = ", ".join(sorted(ENDED))
        return EvidenceError(f"status is {shown(cells['status'])}, none of: {known}", where=where, remedy=_REMEDY)
    return None


def shown(text: str) -> str:
    """Return a cell of whoever wrote the table in quotes, not longer than fits into a message."""
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def _newer(where: str, version: float) -> FieldkitError:
    """Return the error of a table that this fieldkit is too old for."""
    return ConfigurationError(
        f"written by a newer fieldkit: its schema is {version:.0f}, this one knows {SCHEMA_VERSION}",
        where=where,
        remedy="upgrade fieldkit",
    )
