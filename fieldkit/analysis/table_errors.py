"""Checks of tables: the first invalid line and its error, impossible values, contradictions between columns."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from fieldkit.analysis.parsing import Numbers
from fieldkit.analysis.quantities import Quantity, quantities
from fieldkit.core.columns import MISSING, SCHEMA_VERSION, Column, Kind
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError
from fieldkit.core.model import FINAL_STATUSES

_MAX_SHOWN: Final = 40
"""Maximum number of characters of a cell in a message."""
_TOLERANCE: Final = 1e-6  # larger than the rounding errors of numbers in a table
_REMEDY: Final = "correct the line, or create the file again: fieldkit rebuild TRIAL"
_SPREADSHEET_REMEDY: Final = (
    "a spreadsheet has removed digits: name the trial.csv in the trial's folder, or create it again: "
    "fieldkit rebuild TRIAL; in a spreadsheet, open this column as text"
)


def are_possible(values: Numbers, column: Column) -> bool:
    """Return True if all values of a column are possible or missing, by the rule of `Column.invalid_value_reason`."""
    present = values[~np.isnan(values)]
    low, high = column.possible_range if column.type is not bool else (0, 1)
    is_in_range = (present >= low) & (present <= high)
    return bool((is_in_range & (present == np.floor(present))).all() if column.type is int else is_in_range.all())


def contradiction(numbers: Mapping[str, ArrayLike], quantities: Iterable[Quantity]) -> Quantity | None:
    """Return a counted quantity whose share contradicts its counts, or None if there is no contradiction.

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
    """Return the error of the first invalid line, or None if all lines are valid.

    Args:
        where: The file, for messages.
        content: Content of the file.
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


def _explain_row(
    where: str, names: Sequence[str], row: Sequence[str], declared: Mapping[str, Column]
) -> FieldkitError | None:
    """Return the error of a row; None if the row is valid."""
    if len(row) != len(names):
        return EvidenceError(f"{len(row)} cells in a table of {len(names)} columns", where=where, remedy=_REMEDY)
    cells = dict(zip(names, row, strict=True))
    for name, column in declared.items():
        value = cells.get(name, "")
        if (problem := column.invalid_value_reason(value)) is not None:
            remedy = _SPREADSHEET_REMEDY if column.unit == "ns" and "e" in value.lower() else _REMEDY
            return EvidenceError(f"{name} is {_quoted_cell(value)}, {problem}", where=where, remedy=remedy)
    numeric = (name for name, column in declared.items() if column.type in {int, float})
    numbers = {name: float(cells.get(name) or "nan") for name in numeric}
    if (quantity := contradiction(numbers, quantities(declared.values()))) is not None:
        share, arrived, sent = (cells[name] for name in quantity.columns)
        message = f"{quantity.name} is {share}, but {quantity.arrived} is {arrived} of {sent}"
        return EvidenceError(message, where=where, remedy=_REMEDY)
    if cells["schema_version"] not in MISSING and float(cells["schema_version"]) > SCHEMA_VERSION:
        return _newer_schema_error(where, float(cells["schema_version"]))
    if cells["status"] not in FINAL_STATUSES:
        possible = ", ".join(sorted(FINAL_STATUSES))
        return EvidenceError(
            f"status is {_quoted_cell(cells['status'])}, not one of: {possible}", where=where, remedy=_REMEDY
        )
    return None


def _quoted_cell(text: str) -> str:
    """Return a cell of a table in quotes, shortened for a message."""
    return repr(text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}...")


def _newer_schema_error(where: str, version: float) -> FieldkitError:
    """Return the error of a table that a newer version of fieldkit wrote."""
    return ConfigurationError(
        f"its schema version is {version:.0f}, but this version of fieldkit supports at most {SCHEMA_VERSION}",
        where=where,
        remedy="upgrade fieldkit",
    )
