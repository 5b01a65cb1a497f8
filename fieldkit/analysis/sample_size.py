"""Sample sizes: how many repeats or packets an expectation needs, and how many additional repeats a cell needs.

Expectations are checked before the trial runs. Additional repeats narrow the interval of a cell to a requested width.

A cell has the estimates and counts of the repeats under one condition.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.analysis import one_sided_bounds
from fieldkit.analysis.expectations import Expectation, Scope
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.statistics import CONFIDENCE, MIN_FOR_ORDER_STATISTICS, NORMAL, Intervals, student
from fieldkit.core.columns import Kind

if TYPE_CHECKING:  # not imported at run time: a plan needs no tables, and the import is slow
    from fieldkit.analysis.cells import Cell

_EXAMPLE_SHARE = 0.9
"""Share of all repeats that the message about `every` uses as an example."""


def unmet_requirements(
    expectations: Iterable[Expectation], measured_quantities: Iterable[Quantity], repeats: int
) -> Iterator[str]:
    """Yield a sentence for each expectation that may need more repeats or packets than a trial has.

    Args:
        expectations: Expectations of the trial.
        measured_quantities: Quantities that the repeats measure, including the quantities of the expectations.
        repeats: Number of repeats per protocol.
    """
    quantities_by_name = {quantity.name: quantity for quantity in measured_quantities}
    for expectation in expectations:
        if requirement := _requirement(expectation, quantities_by_name[expectation.quantity], repeats):
            yield f"expected {expectation.text}: {requirement}"


def _requirement(expectation: Expectation, quantity: Quantity, repeats: int) -> str:
    """Return what an expectation needs, as text; empty if the planned repeats are enough."""
    available_text = f"this trial has {repeats}"
    if expectation.scope is Scope.PACKETS:
        packets = one_sided_bounds.packets_for(expectation.bound)
        return f"needs at least {packets} packets per condition for 95 % confidence, even if no packet is lost"
    if expectation.scope is Scope.SHARE and expectation.share is not None:
        needed = one_sided_bounds.repeats_for(expectation.share)
        text = f"needs at least {needed} repeats for 95 % confidence, if all meet it; {available_text}"
        return text if repeats < needed else ""
    if expectation.scope is Scope.EVERY:
        needed = one_sided_bounds.repeats_for(_EXAMPLE_SHARE)
        proven_share = one_sided_bounds.share_low(repeats, repeats)
        return (
            "applies only to the repeats of this trial; to show with 95 % confidence that at least "
            f"{100 * _EXAMPLE_SHARE:.0f} % of all repeats meet it, at least {needed} repeats are needed; "
            f"with {repeats}, it can be shown only for {math.floor(100 * proven_share)} %"
            if repeats < needed
            else ""
        )
    needed = _repeats_for_interval(expectation, quantity)
    if repeats < needed:
        alternative = f"; to check only the packets of this trial, write: {expectation.text} of all packets"
        has_alternative = quantity.kind is Kind.COUNTED and expectation.is_below
        return f"{_repeats_text(needed, quantity)}; {available_text}{alternative if has_alternative else ''}"
    if quantity.kind is Kind.MEDIAN and repeats < MIN_FOR_ORDER_STATISTICS:
        coverage = f"{100 * CONFIDENCE:.0f} % confidence for any distribution of the repeats"
        return f"needs at least {MIN_FOR_ORDER_STATISTICS} repeats for {coverage}; {available_text}"
    return ""


def _repeats_text(needed: int, quantity: Quantity) -> str:
    """Return the number of repeats that the interval of a quantity needs, with the reason or the best case."""
    if quantity.kind is not Kind.FLAG and quantity.unit != "share":
        return f"needs at least {needed} repeats, because fewer give no interval"
    best_case = "if it is true in all of them" if quantity.kind is Kind.FLAG else "even if nothing is lost"
    return f"needs at least {needed} repeats for 95 % confidence, {best_case}"


def _repeats_for_interval(expectation: Expectation, quantity: Quantity) -> int:
    """Return the smallest number of repeats with which the 95 % interval of a figure can be within the bound.

    For a share, it is computed with the score interval of repeats without loss (Wilson 1927), whose end is
    z²/(n + z²). Because of the factor 1 + 1e-12, rounding errors do not reduce the number. Other quantities need two
    repeats, because a single repeat has no interval.
    """
    if quantity.unit != "share" or quantity.kind is Kind.MEDIAN:
        return 2
    max_end = expectation.bound if expectation.is_below else 1 - expectation.bound
    if not 0 < max_end < 1 or (quantity.kind is not Kind.FLAG and not expectation.is_below):
        return 2
    return max(math.floor(NORMAL**2 * (1 / max_end - 1) * (1 + 1e-12)) + 1, 2)


_BISECTIONS: Final = 60  # enough for every number of repeats that a float represents exactly


def additional_repeats_by_cell(
    cells: "Sequence[Cell]", half_widths: Mapping[str, float]
) -> tuple[Mapping[str, int], ...]:
    """Return the result of `additional_repeats` for all estimates of each cell, by name of the quantity.

    Args:
        cells: Cells with estimates of any quantities.
        half_widths: Requested half-width by unit. Quantities with other units, and estimates without an interval, are
            not in the result.
    """
    more_by_cell: tuple[dict[str, int], ...] = tuple({} for _ in cells)
    quantities = {estimate.quantity for cell in cells for estimate in cell.estimates.values()}
    for quantity in (quantity for quantity in quantities if quantity.unit in half_widths):
        indices = [index for index, cell in enumerate(cells) if quantity.name in cell.estimates]
        estimates = [cells[index].estimates[quantity.name] for index in indices]
        ends = np.array([(estimate.value, estimate.low, estimate.high) for estimate in estimates], dtype=np.float64)
        n = [estimate.n for estimate in estimates]
        more = additional_repeats(Intervals(*ends.T), n, half_widths[quantity.unit], quantity.kind, quantity.unit)
        for index, count in zip(indices, more.tolist(), strict=True):
            if not math.isnan(count):
                more_by_cell[index][quantity.name] = int(count)
    return more_by_cell


def additional_repeats(
    intervals: Intervals, n: ArrayLike, half_width: ArrayLike, kind: Kind, unit: str = "share"
) -> NDArray[np.float64]:
    """Return the number of additional repeats until the half-width of an interval is at most `half_width`.

    Additional repeats are assumed to have the same dispersion as the existing repeats, so the number is only a rough
    estimate if there are few repeats. For a share, the effective number of trials per repeat follows from the formula
    of the score interval, even without losses. For other quantities, the width is proportional to the inverse square
    root of the number of repeats. The decrease of Student's quantile is included.

    Args:
        intervals: Intervals as returned by `statistics` or `cells`, shape (cells,).
        n: Number of repeats of each cell.
        half_width: Requested half-width, in the unit of the value.
        kind: Kind of the quantity.
        unit: Unit of the quantity.

    Returns:
        Whole numbers, shape (cells,); 0 if the interval is narrow enough, NaN without an interval.

    Raises:
        ValueError: A requested half-width is not above 0.
    """
    n, requested = np.asarray(n, dtype=np.float64), np.asarray(half_width, dtype=np.float64)
    if not (requested > 0).all():
        raise ValueError(f"half-width {requested}: it must be above 0")
    value, half = intervals.value, (intervals.high - intervals.low) / 2
    is_share = kind is not Kind.MEDIAN and unit == "share"
    bounded = is_share & (intervals.low >= 0) & (intervals.high <= 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(
            bounded, _inverse_trials(value, half) / _inverse_trials(value, requested), (half / requested) ** 2
        )
    ratio = np.maximum(ratio, 1)
    # Intervals without an estimated variance use the normal quantile instead of Student's.
    if is_share:
        uses_student = (kind is not Kind.FLAG) & (value > 0) & (value < 1)
    else:
        uses_student = (n < MIN_FOR_ORDER_STATISTICS) | (kind is Kind.MEAN)
    with_normal = np.ceil(n * ratio * (1 - 1e-12))  # rounding must not increase the result for a ratio of 1
    total = np.where(uses_student, _with_student(n, ratio, with_normal), with_normal)
    return np.asarray(total - n)


def _inverse_trials(share: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quantile²/trials of a score interval with the half-width `half`; infinity for 1/2 and more."""
    spread, square = share * (1 - share), half**2
    a, b = 0.25 - square, spread - 2 * square
    root = np.sqrt(b * b + 4 * a * square)
    # Of the two forms of the solution, each is used where it has no difference of nearly equal numbers.
    solution = np.where(b > 0, 2 * square / (root + b), (root - b) / (2 * a))
    return np.where(half < 0.5, solution, np.inf)


def _with_student(
    n: NDArray[np.float64], ratio: NDArray[np.float64], enough: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the smallest N with quantile(N)²/N <= quantile(n)²/n / ratio; `enough` is an upper bound of N."""
    low, high = np.broadcast_to(n, enough.shape), enough
    goal = student(np.maximum(n - 1, 1)) ** 2 / n / ratio * (1 + 1e-12)
    for _ in range(_BISECTIONS):
        middle = np.floor((low + high) / 2)
        is_enough = student(np.maximum(middle - 1, 1)) ** 2 / middle <= goal
        low, high = np.where(is_enough, low, middle + 1), np.where(is_enough, middle, high)
    return high
