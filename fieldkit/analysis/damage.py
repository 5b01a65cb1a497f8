"""What is wrong with a CSV of repeats: slow, line by line, and only for one that was found wanting."""

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Final

from fieldkit.analysis.parsing import TEXT_UNITS
from fieldkit.core.columns import SCHEMA_VERSION
from fieldkit.core.errors import ConfigurationError, EvidenceError, FieldkitError
from fieldkit.core.model import ENDED

_REMEDY: Final = "mend the line, or make the file again: fieldkit rebuild TRIAL"


def newer(where: str, version: float) -> FieldkitError:
    """Return the error of a table that this fieldkit is too old for."""
    return ConfigurationError(
        f"written by a newer fieldkit: its schema is {version:.0f}, this one knows {SCHEMA_VERSION}",
        where=where,
        remedy="upgrade fieldkit",
    )


def explain(where: str, content: bytes, units: Mapping[str, str]) -> FieldkitError | None:
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
            return EvidenceError(f"{name} is {value!r}, not {kind}", where=where, remedy=_REMEDY)
    if cells["schema_version"] and float(cells["schema_version"]) > SCHEMA_VERSION:
        return newer(where, float(cells["schema_version"]))
    if cells["status"] not in ENDED:
        known = ", ".join(sorted(ENDED))
        return EvidenceError(f"status is {cells['status']!r}, none of: {known}", where=where, remedy=_REMEDY)
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
