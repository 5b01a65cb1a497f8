"""Arrow tables of repeats, cells and packets; tables of repeats as CSV and Parquet files for pandas, polars and R."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import Any, BinaryIO, Final, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from fieldkit import __version__
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.parsing import Numbers, Texts
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.result_tables import estimate_rows
from fieldkit.core.columns import SCHEMA_VERSION, Column, cell_text, csv_text
from fieldkit.core.result_rows import EstimateRow, declared_columns
from fieldkit.measure.transfers import fates
from fieldkit.measure.transfers.fates import SentPackets

Table: TypeAlias = pa.Table

_TYPES: Final[Mapping[type, pa.DataType]] = {
    str: pa.dictionary(pa.int32(), pa.string()),
    bool: pa.bool_(),
    int: pa.int64(),
    float: pa.float64(),
}
"""Arrow type by the Python type of a column."""


def write_csv(file: BinaryIO, repeats: Repeats) -> None:
    """Write all columns except `source`. The columns that every trial has are first.

    Raises:
        OSError: The file cannot be written.
    """
    table = repeats_table(repeats)
    lines = zip(*(column.to_pylist() for column in table.columns), strict=True)
    file.write(csv_text(table.column_names, lines).encode())


def write_parquet(file: BinaryIO, repeats: Repeats) -> None:
    """Write all columns except `source` with their types. Units and meanings are metadata of the columns.

    Raises:
        OSError: The file cannot be written.
    """
    pa.parquet.write_table(repeats_table(repeats), file, compression="zstd")


def repeats_table(repeats: Repeats) -> Table:
    """Return all columns except `source`, the file that a row was read from. Units and meanings are metadata.

    The columns that every trial has are first.
    """
    arrays = [
        _texts(repeats.texts[column.name])
        if column.name in repeats.texts
        else _numbers(repeats.numbers[column.name], _TYPES[column.type])
        for column in repeats.columns
    ]
    return Table.from_arrays(arrays, schema=_schema(repeats.columns))


def cells_table(by: Sequence[Column], cells: Sequence[Cell]) -> Table:
    """Return the content of `analysis.result_tables.to_csv` as a table, with all digits of the numbers.

    Args:
        by: Columns that define a cell.
        cells: The cells.
    """
    rows = [
        (*(cell.key[column.name] for column in by), *astuple(row)) for cell in cells for row in estimate_rows(cell)
    ]
    columns = (*by, *declared_columns(EstimateRow))
    return _table_of_rows(columns, [[None if value == "" else value for value in row] for row in rows])


def packets_table(transfers: Mapping[str, SentPackets]) -> Table:
    """Return the packets of transfers in one table. Each row contains the name of the step.

    Args:
        transfers: Packets by name of the step; the name is empty for a step without a name.
    """
    columns = (
        Column("step", "text", "Name of the step that sent the packet; empty if the step has no name."),
        *fates.PACKET_COLUMNS,
    )
    schema = _schema(columns)
    parts = [
        Table.from_arrays(
            [
                pa.array([name or None] * len(packets.sent_ns), pa.string()).dictionary_encode(),
                *(pa.array(getattr(packets, field.name), field.type) for field in list(schema)[1:]),
            ],
            schema=schema,
        )
        for name, packets in transfers.items()
    ]
    return pa.concat_tables([schema.empty_table(), *parts]).unify_dictionaries().combine_chunks()


def _table_of_rows(columns: Sequence[Column], rows: Sequence[Sequence[Any]]) -> Table:
    schema = _schema(columns)
    values = zip(*rows, strict=True) if rows else [()] * len(columns)
    return Table.from_arrays(
        [pa.array(column, field.type) for column, field in zip(values, schema, strict=True)], schema=schema
    )


def _schema(columns: Sequence[Column]) -> pa.Schema:
    return pa.schema(
        [
            pa.field(
                cell_text(column.name), _TYPES[column.type], metadata={"unit": column.unit, "meaning": column.meaning}
            )
            for column in columns
        ],
        metadata={"fieldkit_version": __version__, "schema_version": str(SCHEMA_VERSION)},
    )


def _texts(column: Texts) -> pa.Array:
    printable = {text: cell_text(text) for text in set(column.tolist())}
    texts = [printable[text] or None for text in column.tolist()]
    return pa.array(texts, pa.string()).dictionary_encode()


def _numbers(column: Numbers, kind: pa.DataType) -> pa.Array:
    missing = np.isnan(column)
    values = np.where(missing, 0, column)
    return pa.array(values.astype(np.int64) if kind == pa.int64() else values, mask=missing).cast(kind)
