"""Planning of repeats: the number of additional repeats that a cell needs for an interval of a wanted width."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.statistics import MIN_FOR_ORDER_STATISTICS, Intervals, student
from fieldkit.core.columns import Kind

_BISECTIONS: Final = 60  # enough for every number of repeats that a float represents exactly


def more_wanted_of(cells: Sequence[Cell], half_widths: Mapping[str, float]) -> tuple[Mapping[str, int], ...]:
    """Return `more_wanted` of all estimates: for each cell, by name of the quantity.

    Args:
        cells: Cells with estimates of any quantities.
        half_widths: Wanted half-width by unit. Quantities with other units, and estimates without an interval, are
            not in the result.
    """
    more_by_cell: tuple[dict[str, int], ...] = tuple({} for _ in cells)
    quantities = {estimate.quantity for cell in cells for estimate in cell.estimates.values()}
    for quantity in (quantity for quantity in quantities if quantity.unit in half_widths):
        indices = [index for index, cell in enumerate(cells) if quantity.name in cell.estimates]
        estimates = [cells[index].estimates[quantity.name] for index in indices]
        ends = np.array([(estimate.value, estimate.low, estimate.high) for estimate in estimates], dtype=np.float64)
        n = [estimate.n for estimate in estimates]
        more = more_wanted(Intervals(*ends.T), n, half_widths[quantity.unit], quantity.kind, quantity.unit)
        for index, count in zip(indices, more.tolist(), strict=True):
            if not math.isnan(count):
                more_by_cell[index][quantity.name] = int(count)
    return more_by_cell


def more_wanted(
    intervals: Intervals, n: ArrayLike, half_width: ArrayLike, kind: Kind, unit: str = "share"
) -> NDArray[np.float64]:
    """Return the number of additional repeats until the half-width of an interval is at most `half_width`.

    It is assumed that further repeats have the same dispersion as the existing ones, so from few repeats the number
    is a rough estimate. For a share, the effective number of trials per repeat follows from the formula of the score
    interval, even without any loss. For other quantities, the width decreases with the square root of the number. The
    decrease of Student's quantile is taken into account.

    Args:
        intervals: Intervals as returned by `statistics` or `cells`, shape (cells,).
        n: Number of repeats of each.
        half_width: Wanted half-width, in the unit of the value.
        kind: Kind of the quantity.
        unit: Unit of the quantity.

    Returns:
        Whole numbers, shape (cells,); 0 if the interval is narrow enough, NaN without an interval.

    Raises:
        ValueError: A wanted half-width is not above 0.
    """
    n, wanted = np.asarray(n, dtype=np.float64), np.asarray(half_width, dtype=np.float64)
    if not (wanted > 0).all():
        raise ValueError(f"half-width {wanted}: it must be above 0")
    value, half = intervals.value, (intervals.high - intervals.low) / 2
    is_share = kind is not Kind.MEDIAN and unit == "share"
    bounded = is_share & (intervals.low >= 0) & (intervals.high <= 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(bounded, _inverse_trials(value, half) / _inverse_trials(value, wanted), (half / wanted) ** 2)
    ratio = np.maximum(ratio, 1)
    # Intervals that use no estimated variance have the normal quantile instead of Student's.
    if is_share:
        estimated = (kind is not Kind.FLAG) & (value > 0) & (value < 1)
    else:
        estimated = (n < MIN_FOR_ORDER_STATISTICS) | (kind is Kind.MEAN)
    with_normal = np.ceil(n * ratio * (1 - 1e-12))  # rounding must not increase a ratio of 1
    total = np.where(estimated, _with_student(n, ratio, with_normal), with_normal)
    return np.asarray(total - n)


def _inverse_trials(share: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quantile²/trials of a score interval with a half-width, which is always below 1/2."""
    spread, square = share * (1 - share), half**2
    a, b = 0.25 - square, spread - 2 * square
    return np.where(half < 0.5, (np.sqrt(b * b + 4 * a * square) - b) / (2 * a), np.inf)


def _with_student(
    n: NDArray[np.float64], ratio: NDArray[np.float64], enough: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the smallest N with quantile(N)²/N <= quantile(n)²/n / ratio; `enough` is an upper bound of N."""
    low, high = np.broadcast_to(n, enough.shape), enough
    goal = student(np.maximum(n - 1, 1)) ** 2 / n / ratio * (1 + 1e-12)
    for _ in range(_BISECTIONS):
        middle = np.floor((low + high) / 2)
        fits = student(np.maximum(middle - 1, 1)) ** 2 / middle <= goal
        low, high = np.where(fits, low, middle + 1), np.where(fits, middle, high)
    return high
