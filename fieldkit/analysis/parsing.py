"""Lines of a CSV to columns, by pyarrow; a table that it refuses is read again by line, to tell what is wrong."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from fieldkit.core.columns import SCHEMA_VERSION
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError
from fieldkit.core.model import ENDED

Numbers = NDArray[np.float64]
Texts = NDArray[np.object_]

TEXT_UNITS: Final = frozenset({"text", "hash"})
_REMEDY: Final = "mend the line, or make the file again: fieldkit rebuild TRIAL"


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


def number_column(cells: Sequence[str], unit: str) -> Numbers:
    """Return the cells of one column of numbers as `columns` reads them.

    Args:
        cells: As `core.columns.cell` writes them.
        unit: Unit of the column.

    Raises:
        ValueError: A cell is no number.
    """
    if unit == "ns" and cells and all(cells):
        return np.array([int(text) for text in cells])
    if unit == "bool":
        return np.array([float(text == "true") if text else np.nan for text in cells])
    return np.array([float(text or "nan") for text in cells])


def first_problem(where: str, content: bytes, units: Mapping[str, str]) -> FieldkitError | None:
    """Return what is wrong with the first damaged line, None where every line is sound.

    Args:
        where: The file, for messages.
        content: Its bytes.
        units: Unit of each column that must be readable.
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
            found = row and _explain_row(f"{where}:{reader.line_num}", names, row, units)
            if found:
                return found
    except csv.Error as error:
        return EvidenceError(f"this is no CSV: {error}", where=f"{where}:{reader.line_num}", remedy=_REMEDY)
    return None


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


def _explain_row(
    where: str, names: Sequence[str], row: Sequence[str], units: Mapping[str, str]
) -> FieldkitError | None:
    if len(row) != len(names):
        return EvidenceError(f"{len(row)} cells in a table of {len(names)} columns", where=where, remedy=_REMEDY)
    cells = dict(zip(names, row, strict=True))
    for name, unit in units.items():
        value = cells.get(name, "")
        if not _is_readable(value, unit):
            kind = "true or false" if unit == "bool" else "a number"
            return EvidenceError(f"{name} is {value[:40]!r}, not {kind}", where=where, remedy=_REMEDY)
    if cells["schema_version"] and float(cells["schema_version"]) > SCHEMA_VERSION:
        return _newer(where, float(cells["schema_version"]))
    if cells["status"] not in ENDED:
        known = ", ".join(sorted(ENDED))
        return EvidenceError(f"status is {cells['status'][:40]!r}, none of: {known}", where=where, remedy=_REMEDY)
    return None


def _is_readable(value: str, unit: str) -> bool:
    if not value or unit in TEXT_UNITS:
        return True
    if unit == "bool":
        return value.lower() in {"true", "false", "0", "1"}
    try:
        return abs(float(value)) < float("inf")
    except ValueError:
        return False


def _newer(where: str, version: float) -> FieldkitError:
    """Return the error of a table that this fieldkit is too old for."""
    return ConfigurationError(
        f"written by a newer fieldkit: its schema is {version:.0f}, this one knows {SCHEMA_VERSION}",
        where=where,
        remedy="upgrade fieldkit",
    )
