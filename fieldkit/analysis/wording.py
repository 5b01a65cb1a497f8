"""Estimates and comparisons as people read them: in per cent and milliseconds, with what tells conditions apart."""

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.compare import Comparison, Difference
from fieldkit.analysis.expectations import Scope
from fieldkit.analysis.judgements import Judgement
from fieldkit.analysis.quantities import APART, Quantity, in_order
from fieldkit.analysis.statistics import CONFIDENCE, FEWEST_FOR_ORDER, assured
from fieldkit.analysis.words import Tally
from fieldkit.core import columns
from fieldkit.core.columns import Kind
from fieldkit.core.model import ENDED, Status
from fieldkit.core.units import format_count

_SECONDS_FROM_S: Final = 10.0
_MBIT_FROM_BIT_S: Final = 1e6
_WHOLE_FROM: Final = 100.0
_MOST_DECIMALS: Final = 9
_UNITLESS: Final = frozenset(("count", "number"))
_NAMED: Final = 3
_MOST_WORDS: Final = 5
_LONGEST_WORD: Final = 30
_PLAIN: Final = re.compile(r"[A-Za-z](?:[\w -]*[A-Za-z])?")

NOT_JUDGED: Final = "words are counted, not judged"
"""What a comparison comes to that has no interval."""


@dataclass(frozen=True)
class Scale:
    """How the numbers of a quantity are written.

    Attributes:
        factor: From SI.
        unit: What is written behind them; empty for counts.
        decimals: How many there are below a hundred; none from there on.
    """

    factor: float
    unit: str
    decimals: int = 2

    def number(self, value: float | None) -> str:
        """Return a number without its unit; empty for None."""
        if value is None:
            return ""
        scaled = self.factor * value
        return f"{scaled:.{self.decimals}f}" if abs(scaled) < _WHOLE_FROM else f"{scaled:.0f}"

    def amount(self, value: float) -> str:
        """Return a number with its unit."""
        return f"{self.number(value)} {self.unit}".rstrip()

    def head(self, label: str) -> str:
        """Return what stands above numbers: `RTT, median (ms)`."""
        return f"{label} ({self.unit})" if self.unit else label

    def interval(self, low: float | None, high: float | None) -> str:
        """Return `[low, high]`, `[low, ...)` where the upper end is open, empty without an interval."""
        if low is None:
            return ""
        return f"[{self.number(low)}, ...)" if high is None else f"[{self.number(low)}, {self.number(high)}]"


def interval(scale: Scale, found: Estimate) -> str:
    """Return the interval of an estimate, marked `*` and `!` as `cautions` explains; empty without one."""
    said = scale.interval(found.low, found.high)
    return said and said + ("*" if is_few(found) else "") + ("!" if hangs_together(found) else "")


def number(scale: Scale, found: Estimate, other: float | None = None) -> str:
    """Return the figure to quote without its unit, `>= 2.30` where only a lower bound is known.

    Args:
        scale: How it is written.
        found: The estimate.
        other: Its mean or 95th percentile instead, which any censored repeat makes a lower bound.
    """
    if other is not None:
        return f"{_at_least(found.n_censored > 0)}{scale.number(other)}"
    return f"{_at_least(found.is_lower_bound)}{scale.number(found.value)}"


def amount(scale: Scale, found: Estimate) -> str:
    """Return the same with its unit."""
    return f"{_at_least(found.is_lower_bound)}{scale.amount(found.value)}"


def _at_least(is_bound: bool) -> str:
    return ">= " if is_bound else ""


def incomplete(found: Estimate) -> str:
    """Return of how many repeats a figure is, `7 of 10`, and of how many there are lower bounds; empty if of all."""
    parts = []
    if found.missing:
        parts.append(f"{found.n} of {found.n_valid}")
    if found.n_censored:
        parts.append(f"{found.n_censored} of {found.n} not ended")
    return ", ".join(parts)


def quoted(figure: str, scale: Scale, found: Estimate, between: str = " ") -> str:
    """Return a figure with its interval, and with of how many repeats it is if not of all.

    Args:
        figure: As `number` or `amount` give it.
        scale: How it is written.
        found: The estimate.
        between: What is between the parts.
    """
    of = incomplete(found)
    return between.join(filter(None, (figure, interval(scale, found), f"({of})" if of else "")))


def judged(one: Judgement) -> tuple[str, str, str, str, str]:
    """Return an expectation, of what it is, what was measured with its interval, and the ruling, in words."""
    of = str((one.cell and one.cell.key.get("protocol")) or one.expectation.protocol or "").upper()
    ruling = f"{one.ruling}: {one.why}" if one.why else str(one.ruling)
    if one.found is None:
        return one.expectation.text, of, "nothing", "", ruling
    measured, bounds = _measured(one, one.found)
    part = incomplete(one.found)
    return one.expectation.text, of, f"{measured} ({part})" if part else measured, bounds, ruling


def _measured(one: Judgement, found: Estimate) -> tuple[str, str]:
    """Return what was measured for a judgement, and the interval or bound by which it was judged."""
    expectation = one.expectation
    how = scale_of(found.quantity, [found.value])
    if expectation.scope is Scope.EVERY:
        worst = found.maximum if expectation.is_below else found.minimum
        how = scale_of(found.quantity, [worst])
        return f"{_at_least(expectation.is_below and found.n_censored > 0)}{how.amount(worst)}", ""
    if expectation.scope is Scope.SHARE and one.met is not None and one.limit is not None:
        return f"{one.met} of {found.n} repeats", f"{Scale(100.0, '%').amount(one.limit)} or more"
    if expectation.scope is Scope.PACKETS and one.limit is not None:
        return how.amount(found.value), f"{how.amount(one.limit)} or less"
    return amount(how, found), interval(how, found)


def is_few(found: Estimate) -> bool:
    """Return whether an interval holds its 95 % only where repeats are normal."""
    return found.assured is not None and found.assured < CONFIDENCE


def hangs_together(found: Estimate) -> bool:
    """Return whether repeats follow each other in time as independent ones hardly do."""
    return found.p_order is not None and found.p_order < 1 - CONFIDENCE


def cautions(cells: Sequence[Cell], names: Collection[str] | None = None) -> Iterator[str]:
    """Yield what the marks of intervals mean, each with what to do.

    Args:
        cells: What is shown.
        names: Which quantities of them; None for all.
    """
    every = [
        (cell, estimate)
        for cell in cells
        for name, estimate in cell.estimates.items()
        if names is None or name in names
    ]
    if few := sorted({estimate.n for _, estimate in every if is_few(estimate)}, reverse=True):
        held = ", ".join(f"{n} repeats give {100 * assured(n):.0f} %" for n in few)
        yield (
            f"* 95 % interval assuming a normal distribution; without that assumption {held}. "
            f"Use {FEWEST_FOR_ORDER} or more repeats"
        )
    apart = [name for name in (cells[0].key if cells else ()) if len({cell.key[name] for cell in cells}) > 1]
    if together := [
        " ".join([estimate.quantity.label, *(key(cell, name) for name in apart)])
        for cell, estimate in every
        if hangs_together(estimate)
    ]:
        more = f" and {len(together) - _NAMED} more" if len(together) > _NAMED else ""
        yield (
            f"! repeats are not independent in time (trend or autocorrelation): "
            f"{'; '.join(together[:_NAMED])}{more}. Their intervals are too narrow. Randomize the order of "
            "conditions, as a campaign does, and measure on "
            "several days"
        )


def scale(quantity: Quantity, cells: Sequence[Cell]) -> Scale:
    """Return in what to write a quantity of these cells."""
    return scale_of(
        quantity, [cell.estimates[quantity.name].value for cell in cells if quantity.name in cell.estimates]
    )


def scale_of(quantity: Quantity, values: Sequence[float]) -> Scale:
    """Return in what to write values of a quantity that stand together: shares in per cent."""
    largest = max(map(abs, values), default=0.0)
    if quantity.unit == "bit/s":
        return Scale(1e-6, "Mbit/s") if largest >= _MBIT_FROM_BIT_S else Scale(1e-3, "kbit/s")
    if quantity.unit == "share":
        return Scale(100.0, "%")
    if quantity.unit == "s":
        return time_scale(largest)
    # Of small numbers as many digits as of large ones.
    decimals = 2 - math.floor(math.log10(largest)) if 0 < largest < 1 else 2
    return Scale(1.0, "" if quantity.unit in _UNITLESS else quantity.unit, min(decimals, _MOST_DECIMALS))


def time_scale(time_s: float) -> Scale:
    """Return in what to write times like this one: milliseconds, from ten seconds on seconds."""
    return Scale(1e3, "ms") if time_s < _SECONDS_FROM_S else Scale(1.0, "s")


def label(quantity: Quantity) -> str:
    """Return what the figure to quote is, in words."""
    return f"{quantity.label}, median" if quantity.kind is Kind.MEDIAN else quantity.label


def shown(cells: Sequence[Cell], quantities: Sequence[Quantity]) -> list[Quantity]:
    """Return the quantities that any of the cells has."""
    return [quantity for quantity in quantities if any(quantity.name in cell.estimates for cell in cells)]


def measured(cells: Sequence[Cell]) -> tuple[Quantity, ...]:
    """Return the quantities that any of the cells has, in order."""
    return in_order(estimate.quantity for cell in cells for estimate in cell.estimates.values())


def key(cell: Cell, name: str) -> str:
    """Return the value of a column that tells conditions, `-` where it is missing."""
    return columns.cell(cell.key[name]) or "-"


def told_by(by: Sequence[str], cells: Sequence[Cell]) -> tuple[list[str], list[str]]:
    """Return the columns in which the cells differ, and those in which all agree.

    A column that only says again what another says is in neither: metres beside the operator's own word for a
    distance, a procedure that is called as its scenario.
    """
    again = {"distance_m"} if "distance" in by else set()
    if {"procedure", "scenario"} <= set(by) and all(cell.key["procedure"] == cell.key["scenario"] for cell in cells):
        again.add("procedure")
    values = {name: {cell.key[name] for cell in cells} for name in by if name not in again}
    return [name for name in values if len(values[name]) > 1], [name for name in values if len(values[name]) == 1]


def counts(cell: Cell) -> str:
    """Return how the attempts of a cell ended: `20 valid, 1 void`."""
    return ended({Status.VALID: cell.n_valid, Status.VOID: cell.n_void, Status.FAILED: cell.n_failed})


def worded(cells: Sequence[Cell]) -> dict[str, str]:
    """Return the labels of the columns of words that any of the cells has, by name and in order."""
    return {name: tally.label for cell in cells for name, tally in cell.tallies.items()}


def tally(cell: Cell, name: str, between: str = ", ") -> str:
    """Return how many valid repeats of a cell have each word of a column: `wet 12, dry 7, 1 without`."""
    found = cell.tallies.get(name)
    if found is None:
        return ""
    without = cell.n_valid - found.n
    return between.join((*_counted(found), *([f"{without} without"] if without else [])))


def tallied(found: Tally) -> str:
    """Return how many repeats have each word: `wet 12, dry 7`."""
    return ", ".join(_counted(found))


def _counted(found: Tally) -> Iterator[str]:
    """Yield the most frequent words with how often each is there, and how many others there are."""
    listed = list(found.counts.items())
    shown = _MOST_WORDS if len(listed) > _MOST_WORDS + 1 else len(listed)
    for word, times in listed[:shown]:
        text = word if len(word) <= _LONGEST_WORD else f"{word[:_LONGEST_WORD]}..."
        yield f"{text if _PLAIN.fullmatch(text) else repr(text)} {times}"
    if others := listed[shown:]:
        yield f"{len(others)} others {sum(times for _, times in others)}"


def ended(numbers: Mapping[str, int]) -> str:
    """Return how many attempts ended in each way, the same way."""
    return ", ".join(f"{numbers[status]} {status}" for status in ENDED if numbers.get(status)) or "none"


def verdict(one: Difference, comparisons: int) -> str:
    """Return what a difference comes to: `B 3.10 points more [1.20, 5.00]`.

    Args:
        one: The difference.
        comparisons: How many were made with it.
    """
    if one.value is None:
        said = f"only {'B' if one.a is None else 'A'} has it"
    elif one.interval is None:
        said = "no interval, so no verdict"
    elif one.seen:
        low, high = sorted((abs(one.interval.low), abs(one.interval.high)))
        more = "more" if one.value > 0 else "less"
        said = f"B {_amount(abs(one.value), one)} {more} {comparison_scale(one).interval(low, high)}"
        if not holds(one):
            said += f"; may be chance among {comparisons}"
    else:
        most = max(abs(one.interval.low), abs(one.interval.high))
        said = f"no difference seen; up to {_amount(most, one)} possible"
    return said + _threshold(one)


def holds(one: Difference) -> bool:
    """Return whether a difference is still one after correction for the number of all."""
    return one.p_holm is not None and one.p_holm < 1 - CONFIDENCE


def conclusions(comparison: Comparison) -> Iterator[str]:
    """Yield what the whole comes to, and what of it could not be compared."""
    made, every = comparison.made, comparison.differences
    seen, held = sum(estimate.seen for estimate in every), sum(holds(estimate) for estimate in every)
    yield (
        f"{format_count(made, 'comparison')}: {format_count(seen, 'difference')} seen, {held} after correction "
        f"for their number; were there none, about {(1 - CONFIDENCE) * made:.1f} would be seen"
    )
    for pair in comparison.pairs:
        if pair.missing_in:
            yield f"not compared, because {pair.missing_in} has no such condition: {pair.name}"
    limited = [
        (pair.name, difference)
        for pair in comparison.pairs
        for difference in pair.differences
        if difference.within is not None
    ]
    missed = [(name, difference) for name, difference in limited if not difference.within]
    if limited:
        yield f"shown to be within its threshold: {len(limited) - len(missed)} of {len(limited)}"
    for name, one in missed:
        yield f"not shown to be within {_limit(one)}: {one.quantity.name} in {name}"
    sides = (("A", [pair.a for pair in comparison.pairs]), ("B", [pair.b for pair in comparison.pairs]))
    for side, cells in sides:
        yield from (f"{side}: {caution[2:]}" for caution in cautions([cell for cell in cells if cell is not None]))


def _threshold(one: Difference) -> str:
    if one.within is None:
        return ""
    return f"; {'within' if one.within else 'may exceed'} {_limit(one)}"


def comparison_scale(one: Difference) -> Scale:
    """Return in what to write the values of A and B."""
    return scale_of(one.quantity, [side.value for side in (one.a, one.b) if side])


def _limit(one: Difference) -> str:
    return f"{comparison_scale(one).factor * (one.threshold or 0):.6g} {_unit(one)}".rstrip()


def _amount(amount: float, one: Difference) -> str:
    return f"{comparison_scale(one).number(amount)} {_unit(one)}".rstrip()


def _unit(one: Difference) -> str:
    """Return the unit of how far two values are apart: shares, percentage points."""
    return APART.get(one.quantity.unit, comparison_scale(one).unit)
