"""Declarations of CSV columns: name, unit, meaning, possible values, and how the repeats are aggregated.

Each step type declares the columns that it measures; `trial.columns` combines them. A missing value is an empty cell,
never 0.
"""

import csv
import io
import math
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final, Self

from fieldkit.core.model import FaultKind
from fieldkit.core.text import escape_formula, one_line

SCHEMA_VERSION: Final = 7
"""Version of the columns of trial.csv that fieldkit itself declares."""

Value = int | float | bool | str

_TYPES: Final = {"text": str, "hash": str, "bool": bool, "count": int, "B": int, "ns": int}
_EXACT_INTEGERS: Final = (0, 2**53)  # a float represents these exactly, so every program reads them correctly
_MAX_TIME_S: Final = 1e10  # about 300 years
_UNIT_BOUNDS: Final[Mapping[str, tuple[float, float]]] = {
    "count": _EXACT_INTEGERS,
    "B": _EXACT_INTEGERS,
    "ns": (0, 2**63 - 1),
    "share": (0, 1),
    "s": (0, _MAX_TIME_S),
    "m": (0, 1e9),
    "m/s": (0, 299_792_458),
    "bit/s": (0, 1e15),
    "ppm": (-1e6, 1e6),
}
"""Smallest and largest possible value by unit; values of other units can be any finite number."""

NEGATIVE_LOSS_BOUNDS: Final = (-1000.0, 1.0)
"""Bounds of a loss that may be negative.

The received count can exceed the sent count if datagrams are duplicated, or if the sender's capture has one large
frame that the network card divides into segments (at most about a hundred).
"""
CLOCK_DIFFERENCE_BOUNDS_S: Final = (-_MAX_TIME_S, _MAX_TIME_S)
"""Bounds of the difference between two clocks."""

# No two adjacent parts match the same digits, so matching takes linear time.
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MAX_INT_DIGITS: Final = 19  # digits of the largest 64-bit integer
_BOOL_TEXTS: Final = frozenset(("true", "True", "TRUE", "1", "false", "False", "FALSE", "0"))
MISSING: Final = ("", "nan", "NaN")
"""Texts of a cell without a value; fieldkit itself writes the empty string."""

_NAME: Final = re.compile(r"[a-z][a-z0-9_]*(?:\.[a-z][a-z0-9_]*)*")
_MAX_LENGTHS: Final = {"name": 100, "unit": 20, "meaning": 1000, "label": 100}
"""Maximum length in characters, so that tables stay readable."""

Bounds = tuple[float, float]
"""Smallest and largest value."""


class Kind(StrEnum):
    """How the repeats of a condition are aggregated.

    `counted`: lost items divided by sent items, summed over all repeats; `mean`: mean of one number per repeat;
    `median`: median of one number per repeat; `flag`: share of the repeats in which it is true; `words`: number of
    repeats per distinct text.
    """

    COUNTED = "counted"
    MEAN = "mean"
    MEDIAN = "median"
    FLAG = "flag"
    WORDS = "words"


FIRST_EXTERNAL_RANK: Final = 100
"""Default rank of a figure.

It is the rank of figures of other packages and labs, and of several of fieldkit's steps, such as `roam` and `fly`.
"""
BACKGROUND: Final = 1000
"""Lowest rank of fieldkit's background figures, which every trial has; they are listed last."""


@dataclass(frozen=True)
class Figure:
    """How the repeats of a column are aggregated into one number for summaries, comparisons and reports.

    Attributes:
        label: Label in tables and on axes.
        kind: Kind of aggregation.
        arrived: Column with the number of received items; None unless the kind is `counted`.
        sent: Column with the number of sent items; None unless the kind is `counted`.
        rank: Sort key among the figures of a table; figures of equal rank keep the order of columns. With a rank
            from `FIRST_EXTERNAL_RANK` to below `BACKGROUND`, fieldkit's own figures are displayed like those of other
            packages (`Quantity.is_builtin` is False).
        at_least: Column with the duration observed so far, for repeats in which the event had not ended (a
            right-censored value); in these repeats the figure's own column is empty. Allowed only for medians. The
            column must have the same unit and no figure.
        of_sent: Column with the same statistic over all sent items, in which the value of a lost item is infinite;
            empty if the result is infinite. It is used for a figure that is computed from received items only, such
            as a median RTT. An expectation `NAME < AMOUNT` must then be true for this column and for the figure's own
            column. Allowed only for medians. The column must have the same unit.
    """

    label: str
    kind: Kind
    arrived: str | None = None
    sent: str | None = None
    rank: int = FIRST_EXTERNAL_RANK
    at_least: str | None = None
    of_sent: str | None = None


PHY_RATE: Final = "phy_rate_bit_s"
"""End of the names of columns of PHY rates. Their values remain valid if the clock of the robots does not measure
real durations (`backends.protocols.INSTRUCTIONS`)."""


@dataclass(frozen=True)
class Column:
    """One declared column.

    Attributes:
        name: Column name.
        unit: Unit, or the kind of value if it has no unit.
        meaning: What the value is, and when it is empty.
        rank: Sort key among the columns of trial.csv, from the left; columns of equal rank keep the order of
            declaration. Columns of schema versions 1 and 2 have ranks below 100, so that their order never changes.
        bounds: Smallest and largest possible value; None for the bounds of the unit.
        figure: How the repeats are aggregated; None if they are not.
    """

    name: str
    unit: str
    meaning: str
    rank: int = 100
    bounds: Bounds | None = None
    figure: Figure | None = None

    @property
    def type(self) -> type[int] | type[float] | type[bool] | type[str]:
        """Type of the values, derived from the unit."""
        return _TYPES.get(self.unit, float)

    @property
    def possible_range(self) -> Bounds:
        """Smallest and largest possible value, both included, after rounding as in the CSV."""
        low, high = self.bounds or _UNIT_BOUNDS.get(self.unit, (-sys.float_info.max, sys.float_info.max))
        if self.type is float:
            return min(low, float(cell_text(float(low)))), max(high, float(cell_text(float(high))))
        return low, high

    def declaration_error(self) -> str | None:
        """Return the error in this declaration, such as an invalid name, or None if it is valid."""
        if not _NAME.fullmatch(self.name):
            return "its name must consist of lower-case letters, digits and underscores, in parts separated by dots"
        texts = {"name": self.name, "unit": self.unit, "meaning": self.meaning}
        if self.figure is not None:
            texts["label"] = self.figure.label
        for attribute, text in texts.items():
            if not text or len(text) > _MAX_LENGTHS[attribute] or not text.isprintable():
                return f"its {attribute} is not 1 to {_MAX_LENGTHS[attribute]} printable characters"
        if self.bounds is not None and not self.bounds[0] <= self.bounds[1]:
            return f"its bounds {self.bounds[0]:g} and {self.bounds[1]:g} are not in ascending order"
        return None if self.figure is None else self._figure_error(self.figure)

    def _figure_error(self, figure: Figure) -> str | None:
        """Return the reason why the figure cannot aggregate the repeats of this column, or None if it can."""
        if (figure.kind is Kind.WORDS) is not (self.type is str):
            return "a text column needs a figure of kind words, and no other column can have one"
        if (figure.kind is Kind.FLAG) is not (self.type is bool):
            return "a bool column needs a figure of kind flag, and no other column can have one"
        if figure.kind is not Kind.MEDIAN and (figure.at_least or figure.of_sent):
            return "only a median can have a column of lower bounds (at_least) or of all sent items (of_sent)"
        is_counted = figure.kind is Kind.COUNTED
        if (figure.arrived is not None) is not is_counted or (figure.sent is not None) is not is_counted:
            return "a counted figure needs the columns arrived and sent, and no other figure can have them"
        return "the unit of a counted figure must be share" if is_counted and self.unit != "share" else None

    def invalid_value_reason(self, text: str) -> str | None:
        """Return why a text is not a possible value, such as `not a number`; None if it is possible or missing."""
        if self.type is str or text in MISSING:
            return None
        if self.type is bool:
            return None if text in _BOOL_TEXTS else "not true or false"
        stripped = text.strip(" \t")
        if not _NUMBER.fullmatch(stripped):
            return "not a number"
        # Nanoseconds since 1970 need more digits than a float has, so short integers are read as int.
        is_integer = stripped.removeprefix("-").isdigit()
        value: float = int(stripped) if is_integer and len(stripped) <= _MAX_INT_DIGITS else float(stripped)
        # A whole number equals `value // 1`. Infinity passes; it is reported as out of range below.
        if self.type is int and not (is_integer if self.unit == "ns" else value in {math.inf, value // 1}):
            return f"not a whole number, which the unit {self.unit} requires"
        low, high = self.possible_range
        return None if low <= value <= high else f"not from {low:.9g} to {high:.9g}"


def columns(
    rank: int,
    *column_parts: tuple[str, str, str]
    | tuple[str, str, str, Figure | Bounds]
    | tuple[str, str, str, Figure, Bounds],
) -> tuple[Column, ...]:
    """Return columns that have the same rank.

    Args:
        rank: `Column.rank`.
        column_parts: Name, unit and meaning of each column, then optionally its figure and its bounds.

    Raises:
        TypeError: `rank` is not a number.
    """
    if not isinstance(rank, int):  # otherwise a call without a rank would lose its first column silently
        raise TypeError("the first argument of columns is the rank, for example 100")
    return tuple(_make_column(rank, *parts) for parts in column_parts)


def _make_column(rank: int, name: str, unit: str, meaning: str, *optional: Figure | Bounds) -> Column:
    figure = next((part for part in optional if isinstance(part, Figure)), None)
    bounds = next((part for part in optional if not isinstance(part, Figure)), None)
    return Column(name, unit, meaning, rank, bounds, figure)


def with_step_name(name: str, column: Column) -> Column:
    """Return a column with the name of its step as prefix, `up.file_loss`; unchanged if the step has no name."""
    if not name:
        return column
    figure = column.figure
    if figure is not None:
        arrived, sent, at_least, of_sent = (
            related_column and step_prefixed(name, related_column)
            for related_column in (figure.arrived, figure.sent, figure.at_least, figure.of_sent)
        )
        label = f"{name}: {figure.label}"
        figure = replace(figure, label=label, arrived=arrived, sent=sent, at_least=at_least, of_sent=of_sent)
    return replace(column, name=step_prefixed(name, column.name), figure=figure)


def plain_name(name: str) -> str:
    """Return the name of a column without the name of its step."""
    return name.rpartition(".")[2]


def step_prefixed(name: str, plain: str) -> str:
    """Return the name of a step's column, job or file: `up.file_loss`; `plain` if the step has no name."""
    return f"{name}.{plain}" if name else plain


def fault_column_name(kind: FaultKind, quantity: str) -> str:
    """Return the name of a fault's column; `quantity` is for example `outage_s`, `recovery_s` or `recovered`."""
    return f"{kind.replace('-', '_')}_{quantity}"


@dataclass(frozen=True)
class Measured:
    """Measured values of columns, and the reasons why other columns are empty.

    Attributes:
        values: Value by column; never None.
        missing: Reason by column, for columns that are legitimately empty. A repeat is invalid if a declared column
            is in neither mapping.
    """

    values: Mapping[str, Value] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_optional(cls, values: Mapping[str, Value | None], reason: str) -> Self:
        """Return the values that are not None; the other columns are missing for `reason`."""
        return cls(
            {name: value for name, value in values.items() if value is not None},
            {name: reason for name, value in values.items() if value is None},
        )

    @classmethod
    def all_missing(cls, declared_columns: Iterable[Column], reason: str) -> Self:
        """Return a result in which all of these columns are missing for `reason`."""
        return cls(missing={column.name: reason for column in declared_columns})

    def with_step_name(self, name: str) -> Self:
        """Return a copy whose columns have the name of a step as prefix (see `step_prefixed`)."""
        values = {step_prefixed(name, column): value for column, value in self.values.items()}
        return type(self)(values, {step_prefixed(name, column): reason for column, reason in self.missing.items()})

    def without(self, reasons: Mapping[str, str]) -> Self:
        """Return a copy in which some columns are missing.

        Args:
            reasons: Reason by name of each column that becomes missing.
        """
        values = {name: value for name, value in self.values.items() if name not in reasons}
        return type(self)(values, {**self.missing, **reasons})

    def __or__(self, other: "Measured") -> "Measured":
        """Return the values and the missing columns of both results. A column with a value in one is not missing.

        Raises:
            ValueError: A column has a value in both.
        """
        if duplicates := sorted(self.values.keys() & other.values.keys()):
            raise ValueError(f"measured twice: {', '.join(duplicates)}")
        values = {**self.values, **other.values}
        missing = {**other.missing, **self.missing}
        return Measured(values, {name: reason for name, reason in missing.items() if name not in values})


def cell_text(value: object) -> str:
    """Return `value` as the text of a cell: empty for None, `true`/`false`, floats to 9 digits, text in one line."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.9g}" if isinstance(value, float) else one_line(str(value))


def csv_text(names: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a header line and lines of values as CSV (RFC 4180, but lines end in LF)."""
    return "".join(map(csv_line, (names, *rows)))


def csv_line(values: Iterable[object]) -> str:
    """Return values as one CSV line with a line feed; text that a spreadsheet would read as a formula is escaped."""
    out = io.StringIO()
    cells = (escape_formula(cell_text(value)) if isinstance(value, str) else cell_text(value) for value in values)
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()
