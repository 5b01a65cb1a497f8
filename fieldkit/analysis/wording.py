"""Texts about estimates: numbers with units, intervals, verdicts, cautions.

A cell has the estimates and counts of the repeats under one condition.
"""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.quantities import Quantity, Tally, in_order
from fieldkit.analysis.statistics import CONFIDENCE, MIN_FOR_ORDER_STATISTICS, guaranteed_coverage
from fieldkit.core import columns
from fieldkit.core.columns import Kind
from fieldkit.core.model import FINAL_STATUSES, Status

_MIN_IN_SECONDS_S: Final = 10.0
_MIN_IN_MBIT_BIT_S: Final = 1e6
_MIN_WITHOUT_DECIMALS: Final = 100.0
"""From these values on, times are written in seconds, rates in Mbit/s, and numbers without decimals."""
_MAX_DECIMALS: Final = 9
_UNITLESS: Final = frozenset(("count", "number"))
_MAX_LISTED: Final = 3
"""Maximum number of estimates that a caution names."""
_MAX_WORDS: Final = 5
_MAX_WORD_LENGTH: Final = 30
"""Number of words that are listed with their counts if there are more than one further word, and maximum number of
characters of each."""
_PLAIN_WORD: Final = re.compile(r"[A-Za-z](?:[\w -]*[A-Za-z])?")


@dataclass(frozen=True)
class Scale:
    """Unit and number of decimals in which the numbers of a quantity are written.

    Attributes:
        factor: Factor from the SI unit.
        unit: Unit symbol; empty for counts.
        decimals: Number of decimals of numbers below 100; larger numbers have no decimals.
    """

    factor: float
    unit: str
    decimals: int = 2

    def number(self, value: float | None) -> str:
        """Return a number without its unit; empty for None."""
        if value is None:
            return ""
        scaled = self.factor * value
        return f"{scaled:.{self.decimals}f}" if abs(scaled) < _MIN_WITHOUT_DECIMALS else f"{scaled:.0f}"

    def amount(self, value: float) -> str:
        """Return a number with its unit."""
        return f"{self.number(value)} {self.unit}".rstrip()

    def head(self, label: str) -> str:
        """Return the head of a column of numbers, such as `RTT, median (ms)`."""
        return f"{label} ({self.unit})" if self.unit else label

    def interval(self, low: float | None, high: float | None) -> str:
        """Return `[low, high]`, `[low, ...)` if the upper end is open, or an empty string without an interval."""
        if low is None:
            return ""
        return f"[{self.number(low)}, ...)" if high is None else f"[{self.number(low)}, {self.number(high)}]"


def interval(scale: Scale, estimate: Estimate) -> str:
    """Return the interval of an estimate with the marks `*` and `!` (see `cautions`); empty without an interval."""
    text = scale.interval(estimate.low, estimate.high)
    return text and text + ("*" if assumes_normal(estimate) else "") + ("!" if is_dependent(estimate) else "")


def number(scale: Scale, estimate: Estimate, statistic: float | None = None) -> str:
    """Return the value of an estimate without its unit; a lower bound is written as `>= 2.30`.

    Args:
        scale: Scale of the number.
        estimate: The estimate.
        statistic: Mean or 95th percentile of the estimate, which is written instead of its value. It is a lower bound
            if a repeat is censored.
    """
    if statistic is not None:
        return f"{at_least(estimate.n_censored > 0)}{scale.number(statistic)}"
    return f"{at_least(estimate.is_lower_bound)}{scale.number(estimate.value)}"


def amount(scale: Scale, estimate: Estimate) -> str:
    """Return the value of an estimate with its unit; a lower bound is written as `>= 2.30 s`."""
    return f"{at_least(estimate.is_lower_bound)}{scale.amount(estimate.value)}"


def at_least(is_bound: bool) -> str:
    """Return the prefix of a value that is only a lower bound; empty for other values."""
    return ">= " if is_bound else ""


def incomplete(estimate: Estimate) -> str:
    """Return a text such as `7 of 10, 2 of 7 not ended` if repeats lack a value or are censored; otherwise empty."""
    parts = []
    if estimate.missing:
        parts.append(f"{estimate.n} of {estimate.n_valid}")
    if estimate.n_censored:
        parts.append(f"{estimate.n_censored} of {estimate.n} not ended")
    return ", ".join(parts)


def with_interval(figure: str, scale: Scale, estimate: Estimate, between: str = " ") -> str:
    """Return a figure with its interval and, if repeats lack a value, the number of repeats.

    Args:
        figure: Result of `number` or `amount`.
        scale: Scale of the interval.
        estimate: The estimate.
        between: Separator of the parts.
    """
    note = incomplete(estimate)
    return between.join(filter(None, (figure, interval(scale, estimate), f"({note})" if note else "")))


def assumes_normal(estimate: Estimate) -> bool:
    """Return True if the 95 % coverage of an interval assumes a normal distribution."""
    return estimate.assured is not None and estimate.assured < CONFIDENCE


def is_dependent(estimate: Estimate) -> bool:
    """Return True if a test shows that the repeats are not independent in time (p-value below 5 %)."""
    return estimate.p_order is not None and estimate.p_order < 1 - CONFIDENCE


def cautions(cells: Sequence[Cell], names: Collection[str] | None = None) -> Iterator[str]:
    """Yield an explanation of each mark of intervals, with advice.

    Args:
        cells: The cells that are shown.
        names: Names of the quantities that are shown; None for all.
    """
    selected = [
        (cell, estimate)
        for cell in cells
        for name, estimate in cell.estimates.items()
        if names is None or name in names
    ]
    if few := sorted({estimate.n for _, estimate in selected if assumes_normal(estimate)}, reverse=True):
        coverage = ", ".join(f"{n} repeats give {100 * guaranteed_coverage(n):.0f} %" for n in few)
        yield (
            f"* 95 % interval assuming a normal distribution; without that assumption {coverage}. "
            f"Use {MIN_FOR_ORDER_STATISTICS} or more repeats"
        )
    varying = [name for name in (cells[0].key if cells else ()) if len({cell.key[name] for cell in cells}) > 1]
    if dependent := [
        " ".join([estimate.quantity.label, *(key(cell, name) for name in varying)])
        for cell, estimate in selected
        if is_dependent(estimate)
    ]:
        more = f" and {len(dependent) - _MAX_LISTED} more" if len(dependent) > _MAX_LISTED else ""
        yield (
            f"! repeats are not independent in time (trend or autocorrelation): "
            f"{'; '.join(dependent[:_MAX_LISTED])}{more}. Their intervals are too narrow. Randomize the order of "
            "conditions, as a campaign does, and measure on several days"
        )


def scale(quantity: Quantity, cells: Sequence[Cell]) -> Scale:
    """Return the scale for a quantity of these cells."""
    return scale_of(
        quantity, [cell.estimates[quantity.name].value for cell in cells if quantity.name in cell.estimates]
    )


def scale_of(quantity: Quantity, values: Sequence[float]) -> Scale:
    """Return a common scale for values of a quantity. Shares are in per cent."""
    largest = max(map(abs, values), default=0.0)
    if quantity.unit == "bit/s":
        return Scale(1e-6, "Mbit/s") if largest >= _MIN_IN_MBIT_BIT_S else Scale(1e-3, "kbit/s")
    if quantity.unit == "share":
        return Scale(100.0, "%")
    if quantity.unit == "s":
        return time_scale(largest)
    # Small numbers have as many significant digits as large ones.
    decimals = 2 - math.floor(math.log10(largest)) if 0 < largest < 1 else 2
    return Scale(1.0, "" if quantity.unit in _UNITLESS else quantity.unit, min(decimals, _MAX_DECIMALS))


def time_scale(time_s: float) -> Scale:
    """Return the scale for times of this magnitude: seconds from 10 s on, otherwise milliseconds."""
    return Scale(1e3, "ms") if time_s < _MIN_IN_SECONDS_S else Scale(1.0, "s")


def label(quantity: Quantity) -> str:
    """Return the label of the estimates of a quantity."""
    return f"{quantity.label}, median" if quantity.kind is Kind.MEDIAN else quantity.label


def with_estimates(cells: Sequence[Cell], quantities: Sequence[Quantity]) -> list[Quantity]:
    """Return the quantities that are in at least one of the cells."""
    return [quantity for quantity in quantities if any(quantity.name in cell.estimates for cell in cells)]


def measured(cells: Sequence[Cell]) -> tuple[Quantity, ...]:
    """Return the quantities that are in at least one of the cells, in order."""
    return in_order(estimate.quantity for cell in cells for estimate in cell.estimates.values())


def key(cell: Cell, name: str) -> str:
    """Return the text of a value in a cell's key, `-` if it is missing."""
    return columns.cell_text(cell.key[name]) or "-"


def varying_and_common(by: Sequence[str], cells: Sequence[Cell]) -> tuple[list[str], list[str]]:
    """Return the columns in which the cells differ, and the columns in which all cells are equal.

    Redundant columns are omitted: `distance_m` if `by` also contains the distance as the operator typed it, and the
    procedure if its name equals the scenario in all cells.
    """
    redundant = {"distance_m"} if "distance" in by else set()
    if {"procedure", "scenario"} <= set(by) and all(cell.key["procedure"] == cell.key["scenario"] for cell in cells):
        redundant.add("procedure")
    values = {name: {cell.key[name] for cell in cells} for name in by if name not in redundant}
    return [name for name in values if len(values[name]) > 1], [name for name in values if len(values[name]) == 1]


def counts(cell: Cell) -> str:
    """Return the number of attempts of a cell by final status, such as `20 valid, 1 void`."""
    return status_counts({Status.VALID: cell.n_valid, Status.VOID: cell.n_void, Status.FAILED: cell.n_failed})


def word_labels(cells: Sequence[Cell]) -> dict[str, str]:
    """Return the labels of the word columns in the cells, by name and in order."""
    return {name: tally.label for cell in cells for name, tally in cell.tallies.items()}


def tally(cell: Cell, name: str, between: str = ", ") -> str:
    """Return the number of valid repeats for each word of a column, such as `wet 12, dry 7, 1 without`.

    Empty if no valid repeat has a word.
    """
    words = cell.tallies.get(name)
    if words is None:
        return ""
    without = cell.n_valid - words.n
    return between.join((*_word_counts(words), *([f"{without} without"] if without else [])))


def tally_text(words: Tally) -> str:
    """Return the number of repeats for each word, such as `wet 12, dry 7`."""
    return ", ".join(_word_counts(words))


def _word_counts(words: Tally) -> Iterator[str]:
    """Yield the most frequent words with their counts, then the number of other words with their total count."""
    listed = list(words.counts.items())
    n_shown = _MAX_WORDS if len(listed) > _MAX_WORDS + 1 else len(listed)
    for word, count in listed[:n_shown]:
        text = word if len(word) <= _MAX_WORD_LENGTH else f"{word[:_MAX_WORD_LENGTH]}..."
        yield f"{text if _PLAIN_WORD.fullmatch(text) else repr(text)} {count}"
    if others := listed[n_shown:]:
        yield f"{len(others)} others {sum(count for _, count in others)}"


def status_counts(numbers: Mapping[str, int]) -> str:
    """Return the numbers of attempts by final status, such as `20 valid, 1 void`; `none` without attempts."""
    return ", ".join(f"{numbers[status]} {status}" for status in FINAL_STATUSES if numbers.get(status)) or "none"
