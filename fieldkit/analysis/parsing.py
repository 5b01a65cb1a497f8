"""Lines of a CSV to columns, by pyarrow."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Texts = NDArray[np.object_]

TEXT_UNITS: Final = frozenset({"text", "hash"})


def columns(
    names: Sequence[str], body: bytes, units: Mapping[str, str]
) -> tuple[dict[str, Numbers], dict[str, Texts], int]:
    """Return columns of numbers and of texts, as `repeats.Repeats` has them, and how many rows they have.

    Args:
        names: All columns of the table, in order.
        body: Its lines without the header, each with its end.
        units: Unit of each column that is wanted; those that the table lacks are missing throughout.

    Raises:
        ValueError: A line or a value is damaged.
    """
    present = [name for name in units if name in names]
    found: Mapping[str, pa.ChunkedArray] = {}
    rows = 0
    if body and present:
        table = pa.csv.read_csv(
            pa.BufferReader(body),
            read_options=pa.csv.ReadOptions(column_names=names, block_size=max(len(body) // 8, 1 << 20)),
            convert_options=pa.csv.ConvertOptions(
                column_types={name: _type(units[name]) for name in present},
                include_columns=present,
                null_values=["", "nan"],
                strings_can_be_null=False,
            ),
        )
        found, rows = dict(zip(present, table.columns, strict=True)), len(table)
    numbers, texts = {}, {}
    for name, unit in units.items():
        column = found.get(name)
        if unit in TEXT_UNITS:
            texts[name] = np.full(rows, "", np.object_) if column is None else _texts(column)
        else:
            numbers[name] = np.full(rows, np.nan) if column is None else _numbers(column)
    return numbers, texts, rows


def _type(unit: str) -> pa.DataType:
    if unit in TEXT_UNITS:
        return pa.dictionary(pa.int32(), pa.string())
    return {"bool": pa.bool_(), "ns": pa.int64()}.get(unit, pa.float64())


def _texts(column: pa.ChunkedArray) -> Texts:
    encoded = column.unify_dictionaries().combine_chunks()
    known = np.array([*encoded.dictionary.to_pylist(), ""], dtype=np.object_)
    return np.asarray(known[encoded.indices.to_numpy()], dtype=np.object_)


def _numbers(column: pa.ChunkedArray) -> Numbers:
    if column.type == pa.int64():
        return np.asarray(column.to_numpy())
    typed = column.cast(pa.uint8()) if column.type == pa.bool_() else column
    return np.asarray(typed.cast(pa.float64()).to_numpy(), dtype=np.float64)
