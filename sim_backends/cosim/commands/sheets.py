"""Tables of results, whose columns have a unit and a meaning, printed in four formats."""

import math
import re
import shutil
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from fieldkit.cli.display import print_table
from fieldkit.core.columns import csv_text
from fieldkit.core.text import json_text, print_text

Value = str | int | float | None
"""A cell; nan and None are missing values."""

_MAX_WIDTH: Final = 98
"""Largest line length of legends; it also applies in a wider terminal."""

_MISSING: Final = "-"
"""Text of a missing value in a printed table."""
_NUMBER: Final = re.compile(r"-|-?[0-9][0-9.,]*(e[+-]?[0-9]+)?")
"""A number in a printed table, or a missing value; columns of numbers are aligned at the right."""


@dataclass(frozen=True)
class SheetColumn:
    """A column.

    Attributes:
        name: Its name in CSV and JSON, with its SI unit.
        head: Its heading in printed tables, with the unit shown there.
        meaning: Explanation of the heading; empty if the heading is sufficient.
        factor: Factor from the SI unit to the shown unit.
        digits: Number of significant digits that are shown.
    """

    name: str
    head: str
    meaning: str
    factor: float = 1.0
    digits: int = 3

    def shown_text(self, value: Value) -> str:
        """Return the text of a value in a printed table."""
        if value is None or isinstance(value, str):
            return value or _MISSING
        scaled = value * self.factor
        if isinstance(value, int) and self.factor == 1:
            return f"{value:,}"
        return _MISSING if math.isnan(scaled) else number_text(scaled, self.digits)


@dataclass(frozen=True)
class SheetPart:
    """Some columns of a table, which are printed as a separate table.

    Attributes:
        title: Its title.
        columns: Names of its columns.
    """

    title: str
    columns: Collection[str]


@dataclass(frozen=True)
class Sheet:
    """A table.

    Attributes:
        columns: Its columns.
        rows: Its rows, each with a value per column.
        parts: The printed tables.
    """

    columns: Sequence[SheetColumn]
    rows: Sequence[Sequence[Value]]
    parts: Sequence[SheetPart]

    def part_cells(self, part: SheetPart) -> tuple[list[str], list[list[str]]]:
        """Return the headings and the cells of a part."""
        indices = [index for index, column in enumerate(self.columns) if column.name in part.columns]
        heads = [self.columns[index].head for index in indices]
        return heads, [[self.columns[index].shown_text(row[index]) for index in indices] for row in self.rows]

    def legend(self, part: SheetPart, explained_heads: Collection[str] = ()) -> dict[str, str]:
        """Return the meanings of the headings of a part, except headings that are already explained."""
        columns = [column for column in self.columns if column.name in part.columns and column.meaning]
        meanings = {column.head.partition(" (")[0]: column.meaning for column in columns}
        return {head: meaning for head, meaning in meanings.items() if head not in explained_heads}

    def records(self) -> list[dict[str, Value]]:
        """Return the rows as dictionaries, with None for missing values."""
        names = [column.name for column in self.columns]
        return [
            dict(zip(names, (None if _is_missing(value) else value for value in row), strict=True))
            for row in self.rows
        ]

    def show(self, form: str) -> None:
        """Print the table in one of `FORMS`."""
        FORMS[form](self)


def show_all(sheets: Mapping[str, Sheet], form: str) -> None:
    """Print several tables in one of `FORMS`: JSON contains all of them by name, CSV only the first one.

    Args:
        sheets: The tables by name, the main one first.
        form: The format.
    """
    if form == "json":
        records = {name: sheet.records() for name, sheet in sheets.items()}
        print_text(json_text(records, indent=2, allow_nan=False))
        return
    for sheet in list(sheets.values())[: 1 if form == "csv" else None]:
        sheet.show(form)


def number_text(value: float, digits: int = 3) -> str:
    """Return a number as text, rounded to `digits` significant digits: `0.0123`, `12.3`, `12,345`, `1.23e+08`.

    Zeros at the end of the fraction are omitted. Magnitudes from 1000 to 1e7 are rounded to whole numbers. Larger
    ones, and those below 1e-4, have an exponent and 3 digits.
    """
    if value == 0 or 1e-4 <= abs(value) < 1e3:
        text = f"{value:.{digits}g}"
        # The format `g` returns 1e+03 for 999.6, because the rounded number has more digits than requested.
        return f"{value:,.0f}" if "e" in text else text
    return f"{value:,.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.2e}"


def wrapped(text: str) -> str:
    """Return a text wrapped to the width of the terminal, with at most 98 characters per line."""
    return textwrap.fill(text, min(shutil.get_terminal_size().columns - 1, _MAX_WIDTH))


def _table(sheet: Sheet) -> None:
    explained_heads: set[str] = set()
    for part in sheet.parts:
        heads, rows = sheet.part_cells(part)
        right = [index for index in range(len(heads)) if all(_NUMBER.fullmatch(row[index]) for row in rows)]
        print_table(heads, rows, title=part.title, right=right)
        legend = sheet.legend(part, explained_heads)
        explained_heads |= legend.keys()
        if legend:
            print_text(wrapped(_legend_text(legend)))
        print_text()


def _markdown(sheet: Sheet) -> None:
    for part in sheet.parts:
        heads, rows = sheet.part_cells(part)
        for line in (heads, ["---"] * len(heads), *rows):
            print_text(f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |")
        legend = sheet.legend(part)
        print_text("\n" + ". ".join((part.title, *([_legend_text(legend)] if legend else []))) + ".\n")


def _legend_text(legend: Mapping[str, str]) -> str:
    return "; ".join(f"{head}: {meaning}" for head, meaning in legend.items())


def _csv(sheet: Sheet) -> None:
    rows = [[None if _is_missing(value) else value for value in row] for row in sheet.rows]
    print_text(csv_text([column.name for column in sheet.columns], rows), end="")


def _json(sheet: Sheet) -> None:
    print_text(json_text(sheet.records(), indent=2, allow_nan=False))


def _is_missing(value: Value) -> bool:
    return isinstance(value, float) and math.isnan(value)


FORMS: Final[Mapping[str, Callable[[Sheet], None]]] = MappingProxyType(
    {"table": _table, "csv": _csv, "json": _json, "markdown": _markdown}
)
"""Function that prints a table, by the name of the format."""
