"""Tables for people and programs: columns with a unit and a meaning, printed in four forms."""

import math
import re
import shutil
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from fieldkit.cli.display import table
from fieldkit.core.columns import csv_text
from fieldkit.core.printing import say
from fieldkit.core.text import json_text

Value = str | int | float | None
"""A cell; nan and None are missing."""

_WIDEST: Final = 98
"""Columns of a line of explanations, also in a wider terminal."""

_MISSING: Final = "-"
_NUMBER: Final = re.compile(r"-|-?[0-9][0-9.,]*(e[+-]?[0-9]+)?")


@dataclass(frozen=True)
class SheetColumn:
    """A column.

    Attributes:
        name: For programs, with the unit in it; values are in SI units.
        head: For people, with the unit in which they read it.
        meaning: What it says, in a few words; empty where the head does.
        factor: What a value is multiplied by for people.
        digits: How many digits of a number count for people.
    """

    name: str
    head: str
    meaning: str
    factor: float = 1.0
    digits: int = 3

    def shown(self, value: Value) -> str:
        """Return a value for people."""
        if value is None or isinstance(value, str):
            return value or _MISSING
        scaled = value * self.factor
        if isinstance(value, int) and self.factor == 1:
            return f"{value:,}"
        return _MISSING if math.isnan(scaled) else number(scaled, self.digits)


@dataclass(frozen=True)
class SheetPart:
    """Some columns of a table, which people get as a table of their own.

    Attributes:
        title: Above it.
        columns: Names of its columns.
    """

    title: str
    columns: Collection[str]


@dataclass(frozen=True)
class Sheet:
    """A table.

    Attributes:
        columns: Its columns.
        rows: A value per column each.
        parts: What people get of it.
    """

    columns: Sequence[SheetColumn]
    rows: Sequence[Sequence[Value]]
    parts: Sequence[SheetPart]

    def of_part(self, part: SheetPart) -> tuple[list[str], list[list[str]]]:
        """Return the heads and the cells of a part."""
        chosen = [index for index, column in enumerate(self.columns) if column.name in part.columns]
        heads = [self.columns[index].head for index in chosen]
        return heads, [[self.columns[index].shown(row[index]) for index in chosen] for row in self.rows]

    def legend(self, part: SheetPart, told: Collection[str] = ()) -> dict[str, str]:
        """Return what the heads of a part mean, without those that were told already."""
        columns = [one for one in self.columns if one.name in part.columns and one.meaning]
        found = {one.head.partition(" (")[0]: one.meaning for one in columns}
        return {head: meaning for head, meaning in found.items() if head not in told}

    def records(self) -> list[dict[str, Value]]:
        """Return its rows for programs, None for what is missing."""
        names = [column.name for column in self.columns]
        return [
            dict(zip(names, (None if _is_missing(value) else value for value in row), strict=True))
            for row in self.rows
        ]

    def show(self, form: str) -> None:
        """Print it in one of `FORMS`."""
        FORMS[form](self)


def show_all(sheets: Mapping[str, Sheet], form: str) -> None:
    """Print several tables in one of `FORMS`: JSON has them by their names, CSV the first of them only.

    Args:
        sheets: The tables by name, the first being what is asked for above all.
        form: The form.
    """
    if form == "json":
        found = {name: sheet.records() for name, sheet in sheets.items()}
        say(json_text(found, indent=2, allow_nan=False))
        return
    for sheet in list(sheets.values())[: 1 if form == "csv" else None]:
        sheet.show(form)


def number(value: float, digits: int = 3) -> str:
    """Return a number with that many digits that count and no exponent, where that is short."""
    if value == 0 or 1e-4 <= abs(value) < 1e3:
        return f"{value:.{digits}g}"
    return f"{value:,.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.2e}"


def filled(text: str) -> str:
    """Return explanations in lines that fit into the terminal."""
    return textwrap.fill(text, min(shutil.get_terminal_size().columns - 1, _WIDEST))


def _table(sheet: Sheet) -> None:
    told: set[str] = set()
    for part in sheet.parts:
        heads, rows = sheet.of_part(part)
        right = [index for index in range(len(heads)) if all(_NUMBER.fullmatch(row[index]) for row in rows)]
        table(heads, rows, title=part.title, right=right)
        legend = sheet.legend(part, told)
        told |= legend.keys()
        if legend:
            say(filled(_in_words(legend)))
        say()


def _markdown(sheet: Sheet) -> None:
    for part in sheet.parts:
        heads, rows = sheet.of_part(part)
        for line in (heads, ["---"] * len(heads), *rows):
            say(f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |")
        legend = sheet.legend(part)
        say("\n" + ". ".join((part.title, *([_in_words(legend)] if legend else []))) + ".\n")


def _in_words(legend: Mapping[str, str]) -> str:
    return "; ".join(f"{head}: {meaning}" for head, meaning in legend.items())


def _csv(sheet: Sheet) -> None:
    rows = [[None if _is_missing(value) else value for value in row] for row in sheet.rows]
    say(csv_text([column.name for column in sheet.columns], rows), end="")


def _json(sheet: Sheet) -> None:
    say(json_text(sheet.records(), indent=2, allow_nan=False))


def _is_missing(value: Value) -> bool:
    return isinstance(value, float) and math.isnan(value)


FORMS: Final[Mapping[str, Callable[[Sheet], None]]] = MappingProxyType(
    {"table": _table, "csv": _csv, "json": _json, "markdown": _markdown}
)
