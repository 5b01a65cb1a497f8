"""Conversion of CSV lines to columns with pyarrow. If it fails, `table_errors` reads the lines to find the error."""

from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from fieldkit.core.columns import MISSING, Column
from fieldkit.core.text import unescape_formula

Numbers = NDArray[np.float64]
Texts = NDArray[np.object_]
ArrowColumn = pa.ChunkedArray


def columns(
    names: Sequence[str], body: bytes, declared: Mapping[str, Column]
) -> tuple[dict[str, Numbers], dict[str, Texts], int]:
    """Return columns of numbers and of texts, as in `repeats.Repeats`, and the number of rows.

    Args:
        names: Names of all columns of the table, in order.
        body: Lines of the table without the header, with their line ends.
        declared: The requested columns. A column that is missing in the table has no value in any row.

    Raises:
        ValueError: A line or a value is invalid.
    """
    by_name, rows = csv_columns(names, body, declared)
    return *arrow_columns(by_name, declared, rows), rows


def csv_columns(
    names: Sequence[str], body: bytes, declared: Mapping[str, Column]
) -> tuple[Mapping[str, pa.ChunkedArray], int]:
    """Return the declared columns of a table, with the types of `arrow_type`, and the number of rows.

    If the table has none of the declared columns, there are no columns and 0 rows.

    Takes the same arguments and raises the same errors as `columns`.
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
    """Return columns of numbers and of texts, as in `repeats.Repeats`.

    Args:
        by_name: Arrow columns with the types of `arrow_type`.
        declared: The requested columns. A column that is not in `by_name` has no value in any row.
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
    row_by_text: dict[str, int] = {}
    return np.fromiter(map(row_by_text.setdefault, column, count()), np.int64, len(column))


def arrow_type(column: Column) -> pa.DataType:
    """Return the Arrow type of a column."""
    if column.type is str:
        return pa.dictionary(pa.int32(), pa.string())
    return {"bool": pa.bool_(), "ns": pa.int64()}.get(column.unit, pa.float64())


def _numpy_type(column: Column) -> type[np.float64] | type[np.longdouble]:
    """Return the type of a column's numbers. Nanoseconds since 1970 need 61 bits; a double has 53."""
    return np.longdouble if column.unit == "ns" else np.float64


def _texts(column: pa.ChunkedArray) -> Texts:
    """Return a column of texts; missing texts are empty."""
    encoded = column.unify_dictionaries().combine_chunks()
    distinct = np.array([*map(unescape_formula, encoded.dictionary.to_pylist()), ""], dtype=np.object_)
    codes = _buffer_values(encoded.indices, np.int32)
    if encoded.null_count:
        codes = np.where(_missing(column), len(distinct) - 1, codes)
    return np.asarray(distinct[codes], dtype=np.object_)


def _numbers(column: pa.ChunkedArray) -> Numbers:
    """Return a column of numbers; missing numbers are NaN."""
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
    """Return a mask of the missing values."""
    return np.asarray(_buffer_values(column.is_null().cast(pa.uint8()).combine_chunks(), np.uint8) != 0)


def _buffer_values(array: pa.Array, kind: type[np.generic]) -> NDArray[Any]:
    """Return the value buffer of an Arrow array without copying it; missing values are arbitrary.

    `to_numpy` would import pandas if it is installed, which takes longer than reading a table.
    """
    _, values = array.buffers()
    return np.frombuffer(values, kind, len(array), array.offset * np.dtype(kind).itemsize)
