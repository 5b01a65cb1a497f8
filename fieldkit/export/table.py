"""All attempts at repeats as one table, for pandas, polars and R: CSV as in trial.csv, or Parquet with types."""

from collections.abc import Mapping
from typing import BinaryIO, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from fieldkit import __version__
from fieldkit.analysis.parsing import Numbers, Texts
from fieldkit.analysis.repeats import Repeats
from fieldkit.core.columns import SCHEMA_VERSION, csv_text

_TYPES: Final[Mapping[type, pa.DataType]] = {
    str: pa.dictionary(pa.int32(), pa.string()),
    bool: pa.bool_(),
    int: pa.int64(),
    float: pa.float64(),
}


def write_csv(file: BinaryIO, repeats: Repeats) -> None:
    """Write all columns, those of every trial first.

    Raises:
        OSError: The file cannot be written.
    """
    table = _table(repeats)
    lines = zip(*(column.to_pylist() for column in table.columns), strict=True)
    file.write(csv_text(table.column_names, lines).encode())


def write_parquet(file: BinaryIO, repeats: Repeats) -> None:
    """Write the same columns with their types; units and meanings are each column's metadata.

    Raises:
        OSError: The file cannot be written.
    """
    pa.parquet.write_table(_table(repeats), file, compression="zstd")


def _table(repeats: Repeats) -> pa.Table:
    columns = repeats.columns
    types = {one.name: _TYPES[one.type] for one in columns}
    schema = pa.schema(
        [pa.field(one.name, types[one.name], metadata={"unit": one.unit, "meaning": one.meaning}) for one in columns],
        metadata={"fieldkit_version": __version__, "schema_version": str(SCHEMA_VERSION)},
    )
    arrays = [
        _texts(repeats.texts[one.name])
        if one.name in repeats.texts
        else _numbers(repeats.numbers[one.name], types[one.name])
        for one in columns
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _texts(column: Texts) -> pa.Array:
    return pa.array(column, pa.string(), mask=column == "").dictionary_encode()


def _numbers(column: Numbers, kind: pa.DataType) -> pa.Array:
    missing = np.isnan(column)
    values = np.where(missing, 0, column)
    return pa.array(values.astype(np.int64) if kind == pa.int64() else values, mask=missing).cast(kind)
