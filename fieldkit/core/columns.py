"""CSV columns, each declared once: name, unit, meaning, how it is missing, how repeats make one number of it.

A kind of step declares the columns that it measures; `trial.columns` puts them together. Missing is empty, never 0.
"""

import csv
import io
import math
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import Any, Final, Self

from fieldkit.core.model import FaultKind
from fieldkit.core.text import guarded, one_line

SCHEMA_VERSION: Final = 6
"""Version of the columns of trial.csv that fieldkit itself declares."""

Value = int | float | bool | str

_TYPES: Final = {"text": str, "hash": str, "bool": bool, "count": int, "B": int, "ns": int}
_WHOLE: Final = (0, 2**53)  # what a float, and with it every other program, counts exactly
_CENTURIES_S: Final = 1e10
_POSSIBLE: Final[Mapping[str, tuple[float, float]]] = {
    "count": _WHOLE,
    "B": _WHOLE,
    "ns": (0, 2**63 - 1),
    "share": (0, 1),
    "s": (0, _CENTURIES_S),
    "m": (0, 1e9),
    "m/s": (0, 299_792_458),
    "bit/s": (0, 1e15),
    "ppm": (-1e6, 1e6),
}
"""What values of a unit can be; those of another unit can be any finite number."""

OVERCOUNTED: Final = (-1000.0, 1.0)
"""What a loss can be where more may be counted as arrived than as sent: copies of datagrams, or segments of one
super-frame, of which the largest hold some hundred."""
EITHER_WAY_S: Final = (-_CENTURIES_S, _CENTURIES_S)
"""What a difference of two clocks can be."""

# Each digit has one place in it: no two parts share out a long run of them.
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_DIGITS: Final = 19  # of the largest 64-bit integer
_FLAGS: Final = frozenset(("true", "True", "TRUE", "1", "false", "False", "FALSE", "0"))
MISSING: Final = ("", "nan", "NaN")
"""How a cell says that there is no value; fieldkit itself leaves it empty."""

_NAME: Final = re.compile(r"[a-z][a-z0-9_]*(?:\.[a-z][a-z0-9_]*)*")
_MOST_OF: Final = {"name": 100, "unit": 20, "meaning": 1000, "label": 100}
"""Characters that people can still read."""

Bounds = tuple[float, float]
"""Smallest and largest value."""


class Kind(StrEnum):
    """How the repeats of a condition are put together.

    `counted`: a share of things counted over all repeats, each lost or not; `mean`: the mean of a number per repeat;
    `median`: the median of a number per repeat; `flag`: the share of the repeats for which it is true; `words`: how
    many repeats have each word of a text.
    """

    COUNTED = "counted"
    MEAN = "mean"
    MEDIAN = "median"
    FLAG = "flag"
    WORDS = "words"


FIRST_OF_OTHERS: Final = 100
"""Rank of the first figure that is not fieldkit's own."""
BACKGROUND: Final = 1000
"""Rank from which on figures are fieldkit's own again: what every trial has beside what it is about comes last."""


@dataclass(frozen=True)
class Figure:
    """How repeats make one number of a column, for summaries, comparisons and reports.

    Attributes:
        label: What it is in words, for tables and axes.
        kind: How repeats are put together.
        arrived: Column that counts what arrived; None unless counted.
        sent: Column that counts of how many; None unless counted.
        rank: Place among the figures of a table, from the first; equal ranks keep the order of columns. fieldkit's
            own are below `FIRST_OF_OTHERS`, or from `BACKGROUND` on.
        at_least: Column with the observed length of what had not ended (a right-censored value). It has a number in
            a repeat in which the figure's own column is empty for that reason, and is empty in every other. Medians
            only, and of the same unit; it has no figure of its own.
        of_sent: Column with the same statistic over all that was sent, where what was lost counts as later than all
            that arrived; empty where that is infinite. For statistics of what arrived alone: a median RTT. An
            expectation `NAME < AMOUNT` is judged by both. Medians only, and of the same unit.
    """

    label: str
    kind: Kind
    arrived: str | None = None
    sent: str | None = None
    rank: int = FIRST_OF_OTHERS
    at_least: str | None = None
    of_sent: str | None = None


def _column(unit: str, meaning: str) -> Any:  # noqa: ANN401 (as dataclasses.field)
    return field(default=None, metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True)
class Column:
    """One declared column.

    Attributes:
        name: Column name.
        unit: Unit, or the kind of value where it has none.
        meaning: What it says, and when it is empty.
        rank: Place among the columns of trial.csv, from the left; equal ranks keep the order of declaration. Columns
            that came with version 1 or 2 of the schema have ranks below 100, so that their order never changes.
        bounds: Smallest and largest value that is possible, where the unit does not tell.
        figure: How repeats make one number of it; None where they make none.
    """

    name: str
    unit: str
    meaning: str
    rank: int = 100
    bounds: Bounds | None = None
    figure: Figure | None = None

    @property
    def type(self) -> type[int] | type[float] | type[bool] | type[str]:
        """Type of its values, as the unit tells."""
        return _TYPES.get(self.unit, float)

    @property
    def possible(self) -> Bounds:
        """Smallest and largest value that is possible, both included, and what a CSV makes of them."""
        low, high = self.bounds or _POSSIBLE.get(self.unit, (-sys.float_info.max, sys.float_info.max))
        if self.type is float:
            return min(low, float(cell(float(low)))), max(high, float(cell(float(high))))
        return low, high

    def flaw(self) -> str | None:
        """Return what keeps others from reading or showing such a column, None where nothing does."""
        if not _NAME.fullmatch(self.name):
            return "its name is not made of lower-case letters, digits and _, with points between parts"
        texts = {"name": self.name, "unit": self.unit, "meaning": self.meaning}
        if self.figure is not None:
            texts["label"] = self.figure.label
        for what, text in texts.items():
            if not text or len(text) > _MOST_OF[what] or not text.isprintable():
                return f"its {what} is not 1 to {_MOST_OF[what]} printable characters"
        if self.bounds is not None and not self.bounds[0] <= self.bounds[1]:
            return f"no value is from {self.bounds[0]:g} to {self.bounds[1]:g}"
        return None if self.figure is None else self._flaw_of(self.figure)

    def _flaw_of(self, figure: Figure) -> str | None:
        """Return why repeats cannot be put together so."""
        if (figure.kind is Kind.WORDS) is not (self.type is str):
            return "repeats of a text make words, and of nothing else"
        if (figure.kind is Kind.FLAG) is not (self.type is bool):
            return "repeats of what is true or false make a flag, and of nothing else"
        if figure.kind is not Kind.MEDIAN and (figure.at_least or figure.of_sent):
            return "only a median has lower bounds, or a figure over all that was sent"
        is_counted = figure.kind is Kind.COUNTED
        if (figure.arrived is not None) is not is_counted or (figure.sent is not None) is not is_counted:
            return "what is counted, and nothing else, has columns of what arrived and what was sent"
        return "what is counted is a share" if is_counted and self.unit != "share" else None

    def problem(self, text: str) -> str | None:
        """Return what a cell's text is not, `not a number`; None where it is a possible value, or missing."""
        if self.type is str or text in MISSING:
            return None
        if self.type is bool:
            return None if text in _FLAGS else "not true or false"
        said = text.strip(" \t")
        if not _NUMBER.fullmatch(said):
            return "not a number"
        # A double has no room for nanoseconds; other numbers are read as one.
        is_integer = said.removeprefix("-").isdigit()
        value: float = int(said) if is_integer and len(said) <= _DIGITS else float(said)
        if self.type is int and not (is_integer if self.unit == "ns" else value in {math.inf, value // 1}):
            return "not a whole number"
        low, high = self.possible
        return None if low <= value <= high else f"not from {low:.9g} to {high:.9g}"


def columns(
    rank: int,
    *declared: tuple[str, str, str] | tuple[str, str, str, Figure | Bounds] | tuple[str, str, str, Figure, Bounds],
) -> tuple[Column, ...]:
    """Return columns of one rank.

    Args:
        rank: As `Column.rank`.
        declared: Of each its name, unit and meaning; its figure where it has one; its bounds where the unit does not
            tell them.
    """
    return tuple(_declared(rank, *parts) for parts in declared)


def _declared(rank: int, name: str, unit: str, meaning: str, *more: Figure | Bounds) -> Column:
    figure = next((part for part in more if isinstance(part, Figure)), None)
    bounds = next((part for part in more if not isinstance(part, Figure)), None)
    return Column(name, unit, meaning, rank, bounds, figure)


def named(name: str, column: Column) -> Column:
    """Return a column of a step that has a name, `up.file_loss`; of one without, the column as it is."""
    if not name:
        return column
    figure = column.figure
    if figure is not None:
        arrived, sent, at_least, of_sent = (
            other and prefixed(name, other)
            for other in (figure.arrived, figure.sent, figure.at_least, figure.of_sent)
        )
        label = f"{name}: {figure.label}"
        figure = replace(figure, label=label, arrived=arrived, sent=sent, at_least=at_least, of_sent=of_sent)
    return replace(column, name=prefixed(name, column.name), figure=figure)


def plain_name(name: str) -> str:
    """Return what a column is called without the name of its step."""
    return name.rpartition(".")[2]


def prefixed(name: str, what: str) -> str:
    """Return what a column, a job or a file of a step of this name is called: `up.file_loss`; `what` without one."""
    return f"{name}.{what}" if name else what


def of_fault(kind: FaultKind, what: str) -> str:
    """Return the name of the column that says `what` of a kind of fault: `outage_s`, `recovery_s`, `recovered`."""
    return f"{kind.replace('-', '_')}_{what}"


@dataclass(frozen=True)
class Measured:
    """Values of columns, and why others have none.

    Attributes:
        values: By column; never None.
        missing: Reason by column, for those that the evidence rightly leaves empty. A declared column that is in
            neither is a figure that got lost, and no repeat is valid without it.
    """

    values: Mapping[str, Value] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Mapping[str, Value | None], reason: str) -> Self:
        """Return the values that are there; the others are missing for `reason`."""
        return cls(
            {name: value for name, value in values.items() if value is not None},
            {name: reason for name, value in values.items() if value is None},
        )

    @classmethod
    def nothing(cls, declared: Iterable[Column], reason: str) -> Self:
        """Return that all of these columns are missing for `reason`."""
        return cls(missing={column.name: reason for column in declared})

    def named(self, name: str) -> Self:
        """Return the same as the columns of a step of this name; see `prefixed`."""
        values = {prefixed(name, column): value for column, value in self.values.items()}
        return type(self)(values, {prefixed(name, column): why for column, why in self.missing.items()})

    def without(self, reasons: Mapping[str, str]) -> Self:
        """Return all but some columns, which are missing for a reason each."""
        values = {name: value for name, value in self.values.items() if name not in reasons}
        return type(self)(values, {**self.missing, **reasons})

    def __or__(self, other: "Measured") -> "Measured":
        """Return both together.

        Raises:
            ValueError: Both give a value to one column.
        """
        if twice := sorted(self.values.keys() & other.values.keys()):
            raise ValueError(f"measured twice: {', '.join(twice)}")
        values = {**self.values, **other.values}
        missing = {**other.missing, **self.missing}
        return Measured(values, {name: why for name, why in missing.items() if name not in values})


@dataclass(frozen=True, kw_only=True)
class EstimateRow:
    """What summary.csv says of one quantity under one condition, after the columns that name the condition.

    Computed by `analysis.cells`.
    """

    quantity: str | None = _column(
        "text", "Column of trial.csv that the numbers are of; for each word of a text `grass=wet`."
    )
    unit: str | None = _column("text", "Unit of all numbers but the counts: s, bit/s, share, or the column's own.")
    n_valid: int | None = _column("count", "Valid repeats.")
    n_void: int | None = _column("count", "Attempts whose evidence was not whole.")
    n_failed: int | None = _column("count", "Attempts that failed.")
    n: int | None = _column("count", "Valid repeats that have the quantity; all numbers are of these.")
    value: float | None = _column(
        "unit", "The figure to quote: share of all that was counted, mean over repeats, or median over repeats."
    )
    low: float | None = _column(
        "unit", "Lower end of its 95 % interval, the repeat being the unit; empty for a single repeat."
    )
    high: float | None = _column("unit", "Upper end of its 95 % interval.")
    assured: float | None = _column(
        "share",
        "Share of such intervals that hold the truth whatever the distribution of the repeats: below 0.95, the "
        "interval takes them as normal. Medians only.",
    )
    p_order: float | None = _column(
        "share",
        "How often repeats in no order would be as orderly in time as these, corrected for the number of all rows: "
        "below 0.05 they hang together, and the interval is too narrow. Empty of fewer than 10, or 5 values.",
    )
    estimate: str | None = _column(
        "text",
        "What value is: counted, mean, median; or flag, words: share of the repeats, that of words without interval.",
    )
    wilson_low: float | None = _column(
        "unit",
        "Lower end of the 95 % Wilson interval, as if all that was counted were independent. Empty unless counted, "
        "and where more arrived than was sent, as offload lets the paper's filter see.",
    )
    wilson_high: float | None = _column("unit", "Upper end of the 95 % Wilson interval.")
    events: int | None = _column("count", "What was lost, or true, or has the word; empty of means and medians.")
    trials: int | None = _column("count", "Of how many.")
    mean: float | None = _column("unit", "Mean over repeats.")
    median: float | None = _column("unit", "Median over repeats.")
    p95: float | None = _column("unit", "95th percentile over repeats.")
    minimum: float | None = _column("unit", "Smallest of a single repeat.")
    maximum: float | None = _column("unit", "Largest of a single repeat.")
    n_censored: int | None = _column(
        "count",
        "Of n, the repeats of which only a lower bound is known, since what was timed had not ended. Above 0, mean, "
        "p95 and maximum are lower bounds, and `high` is empty where the data give no upper end.",
    )
    is_lower_bound: bool | None = _column("bool", "Whether `value` and `median` are lower bounds, too.")


@dataclass(frozen=True, kw_only=True)
class DifferenceRow:
    """What a comparison of two runs says of one quantity under one condition, after the columns that name it.

    Computed by `analysis.compare`.
    """

    missing_in: str | None = _column("text", "A or B if that run has no such condition; empty if both have.")
    quantity: str | None = _column("text", "Column of trial.csv that the numbers are of.")
    unit: str | None = _column("text", "Unit of all numbers but the counts: s, bit/s, share, or the column's own.")
    estimate: str | None = _column("text", "What a and b are: counted, mean, median, or flag (share of the repeats).")
    n_a: int | None = _column("count", "Valid repeats of A that have the quantity.")
    n_b: int | None = _column("count", "Valid repeats of B that have it.")
    a: float | None = _column("unit", "What A measured, as `value` of summary.csv; empty if it did not.")
    b: float | None = _column("unit", "What B measured.")
    difference: float | None = _column("unit", "b - a.")
    low: float | None = _column("unit", "Lower end of its 95 % interval; empty where a or b has no interval.")
    high: float | None = _column("unit", "Upper end of its 95 % interval.")
    cliffs_delta: float | None = _column(
        "share", "Pairs of repeats in which B is the larger, less those in which it is the smaller: -1 to 1."
    )
    p_holm: float | None = _column(
        "share", "p-value of the difference, corrected by Holm for the number of all that were compared."
    )
    threshold: float | None = _column("unit", "How far apart a and b may be; empty if nobody said.")
    within: bool | None = _column("bool", "Whether the whole interval is within the threshold.")
    verdict: str | None = _column("text", "All of it in words.")


def declared(row: type[Any]) -> tuple[Column, ...]:
    """Return the columns that a dataclass declares by its fields."""
    return tuple(Column(item.name, item.metadata["unit"], item.metadata["meaning"]) for item in fields(row))


def cell(value: object) -> str:
    """Return `value` as text: empty for None, `true`/`false`, floats to 9 digits, text in one printable line."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:.9g}" if isinstance(value, float) else one_line(str(value))


def csv_text(names: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a header line and lines of values as CSV (RFC 4180, lines end in LF)."""
    return "".join(map(csv_line, (names, *rows)))


def csv_line(values: Iterable[object]) -> str:
    """Return a line of values as CSV, with its end; texts that a spreadsheet takes for formulas are `guarded`."""
    out = io.StringIO()
    cells = (guarded(cell(value)) if isinstance(value, str) else cell(value) for value in values)
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()
