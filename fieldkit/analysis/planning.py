"""Plan repeats: the number that a cell needs more until its interval is as narrow as wanted."""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.statistics import FEWEST_FOR_ORDER, Intervals, student
from fieldkit.core.columns import Kind

_BISECTIONS: Final = 60  # as many repeats as a float counts exactly


def more_wanted_of(cells: Sequence[Cell], half_widths: Mapping[str, float]) -> tuple[Mapping[str, int], ...]:
    """Return `more_wanted` of all estimates: by quantity, per cell.

    Args:
        cells: With estimates of any quantities.
        half_widths: Wanted, by the unit of a quantity; quantities of other units have no number, nor have estimates
            without an interval.
    """
    found: tuple[dict[str, int], ...] = tuple({} for _ in cells)
    quantities = {estimate.quantity for cell in cells for estimate in cell.estimates.values()}
    for quantity in (one for one in quantities if one.unit in half_widths):
        having = [index for index, cell in enumerate(cells) if quantity.name in cell.estimates]
        estimates = [cells[index].estimates[quantity.name] for index in having]
        ends = np.array([(estimate.value, estimate.low, estimate.high) for estimate in estimates], dtype=np.float64)
        n = [estimate.n for estimate in estimates]
        more = more_wanted(Intervals(*ends.T), n, half_widths[quantity.unit], quantity.kind, quantity.unit)
        for index, count in zip(having, more.tolist(), strict=True):
            if not math.isnan(count):
                found[index][quantity.name] = int(count)
    return found


def more_wanted(
    intervals: Intervals, n: ArrayLike, half_width: ArrayLike, kind: Kind, unit: str = "share"
) -> NDArray[np.float64]:
    """Return how many repeats more make half of the interval's width `half_width` at most, 0 where it is.

    It takes further repeats to spread as those that are there do, so from few of these it is a rough guess. What a
    repeat is worth the interval tells: of a share by the score interval's formula, solved for the number of trials,
    also where nothing was lost yet; of a median by the square of its width. Student's quantile shrinks besides.

    Args:
        intervals: As `statistics` or `cells` give them, shape (cells,).
        n: Repeats that each is of.
        half_width: Wanted, in the unit of the value.
        kind: Of the quantity.
        unit: Likewise.

    Returns:
        Whole numbers, shape (cells,); NaN where there is no interval.

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
        ratio = np.where(bounded, _weight(value, half) / _weight(value, wanted), (half / wanted) ** 2)
    ratio = np.maximum(ratio, 1)
    # The others rest on a known distribution and not on an estimated variance: they have the normal quantile.
    if is_share:
        estimated = (kind is not Kind.FLAG) & (value > 0) & (value < 1)
    else:
        estimated = (n < FEWEST_FOR_ORDER) | (kind is Kind.MEAN)
    with_normal = np.ceil(n * ratio * (1 - 1e-12))  # a ratio of 1 is 1, whatever rounding says
    total = np.where(estimated, _with_student(n, ratio, with_normal), with_normal)
    return np.asarray(total - n)


def _weight(share: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quantile²/trials of a score interval of that half-width; none is 1/2 wide or wider."""
    spread, square = share * (1 - share), half**2
    a, b = 0.25 - square, spread - 2 * square
    return np.where(half < 0.5, (np.sqrt(b * b + 4 * a * square) - b) / (2 * a), np.inf)


def _with_student(
    n: NDArray[np.float64], ratio: NDArray[np.float64], enough: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the least N with quantile(N)²/N <= quantile(n)²/n / ratio; `enough` is one."""
    low, high = np.broadcast_to(n, enough.shape), enough
    goal = student(np.maximum(n - 1, 1)) ** 2 / n / ratio * (1 + 1e-12)
    for _ in range(_BISECTIONS):
        middle = np.floor((low + high) / 2)
        fits = student(np.maximum(middle - 1, 1)) ** 2 / middle <= goal
        low, high = np.where(fits, low, middle + 1), np.where(fits, middle, high)
    return high
