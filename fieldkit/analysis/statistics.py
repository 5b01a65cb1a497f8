"""Statistics over repeats with 95 % intervals: shares, means and medians.

Repeats are independent sampling units; the items of a repeat may depend on each other. All formulas are in closed
form and vectorized over cells; a cell is the repeats under one condition. There is no resampling, so results do not
depend on a seed. docs/method-intervals.md has the coverage of the intervals.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

CONFIDENCE: Final = 0.95
"""Confidence level of all intervals."""

NORMAL: Final = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
"""97.5 % quantile of the normal distribution, for a two-sided 95 % interval."""

# 97.5 % quantiles of Student's t with 1 and 2 degrees of freedom, in closed form.
_QUANTILE_1: Final = math.tan(math.pi * CONFIDENCE / 2)
_QUANTILE_2: Final = CONFIDENCE * math.sqrt(2 / (1 - CONFIDENCE**2))
# Coefficients of the expansion in `student`: Abramowitz and Stegun 1964, 26.7.5.
_SERIES: Final = (
    (NORMAL**3 + NORMAL) / 4,
    (5 * NORMAL**5 + 16 * NORMAL**3 + 3 * NORMAL) / 96,
    (3 * NORMAL**7 + 19 * NORMAL**5 + 17 * NORMAL**3 - 15 * NORMAL) / 384,
    (79 * NORMAL**9 + 776 * NORMAL**7 + 1482 * NORMAL**5 - 1920 * NORMAL**3 - 945 * NORMAL) / 92160,
)
_LAST_TERM: Final = 32 * (_QUANTILE_2 - NORMAL - sum(term / 2**power for power, term in enumerate(_SERIES, 1)))
"""Coefficient of the fifth term, which makes the expansion exact for 2 degrees of freedom."""
MIN_FOR_INDEPENDENCE_TESTS: Final = 10
"""Minimum number of repeats. With fewer repeats, p-values cannot be small enough after correction for many tests."""
MIN_FOR_ORDER_STATISTICS: Final = 6  # the range of five values contains the median with a probability of only 93.75 %
_ROUNDING: Final = 1e-12  # smaller relative deviations are rounding errors of equal shares


@dataclass(frozen=True, eq=False)
class Intervals:
    """Estimates of many cells with their intervals.

    Attributes:
        value: Estimates, shape (cells,).
        low: Lower ends; NaN without an interval.
        high: Upper ends; NaN without an interval.
    """

    value: Floats
    low: Floats
    high: Floats


def wilson_intervals(events: ArrayLike, trials: ArrayLike) -> Intervals:
    """Return the share `events/trials` of each cell with its score interval.

    The coverage of the interval is also correct near 0 and 1, values that are typical of packet loss (Wilson 1927,
    J. Am. Stat. Assoc. 22:209). Independent trials are assumed; for losses, which occur in bursts, use `shares`.

    Args:
        events: Number of events, shape (cells,).
        trials: Number of trials, above zero, same shape.

    Returns:
        Shares; without an interval if there are more events than trials, or if events are negative.
    """
    events, trials = np.asarray(events, dtype=np.float64), np.asarray(trials, dtype=np.float64)
    value, is_share = events / trials, (events >= 0) & (events <= trials)
    low, high = _score_interval(np.where(is_share, value, 0), trials, np.full_like(value, NORMAL))
    return Intervals(value, np.where(is_share, low, np.nan), np.where(is_share, high, np.nan))


def shares(lost: ArrayLike, sent: ArrayLike) -> Intervals:
    """Return the share of lost items of each cell, with an interval that accounts for bursts.

    The share is a ratio of sums over repeats, whose variance is linearized over repeats (Cochran 1977, Sampling
    Techniques, 6.4). The effective sample size is the number of independent trials with this variance. The interval
    is their score interval with a t quantile (Korn and Graubard 1998, Survey Methodology 24:193, on Wilson's
    interval; Franco, Little, Louis and Slud 2019, J. Surv. Stat. Methodol. 7:334). The degrees of freedom follow from
    the fourth moment of the repeats (Satterthwaite 1946, Biometrics Bull. 2:110), so they are few if one repeat has
    nearly all losses.

    If no item was lost, or all items were lost, the data contain no information about bursts, and each repeat is one
    trial of `wilson_intervals`.

    Args:
        lost: Number of lost items of each repeat, shape (cells, n).
        sent: Number of sent items of each repeat, same shape.

    Returns:
        Shares; without an interval if n is 1 or the share is outside of 0..1.
    """
    lost, sent = np.asarray(lost, dtype=np.float64), np.asarray(sent, dtype=np.float64)
    n, total = lost.shape[1], sent.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = lost.sum(axis=1) / total
        deviations = lost - value[:, None] * sent
        squares, freedom = _squares_and_freedom(np.where(np.abs(deviations) > _ROUNDING * sent, deviations, 0))
        trials = value * (1 - value) * total**2 * (n - 1) / (n * squares)
        # Repeats with equal shares have variance 0, but the share is not certain. Losses are then treated as
        # independent.
        trials = np.where(squares > 0, trials, total)
        # Effective number of repeats (Kish 1965, Survey Sampling, 11.7): n if all repeats sent the same number.
        repeats = total**2 / (sent**2).sum(axis=1)
        is_mixed = (value > 0) & (value < 1)
        quantile = np.where(is_mixed, student(freedom), NORMAL)
        low, high = _score_interval(value, np.where(is_mixed, trials, repeats), quantile)
    has_interval = (n > 1) & (value >= 0) & (value <= 1)
    return Intervals(value, np.where(has_interval, low, np.nan), np.where(has_interval, high, np.nan))


def mean_shares(values: ArrayLike) -> Intervals:
    """Return the mean of the shares of each cell, one share per repeat: `shares` with equal weights.

    Unlike `means`, it accounts for the bounds of a share: even if no repeat has a loss, the upper end is above 0.

    Args:
        values: Shares, shape (cells, n).

    Returns:
        Means; cells with a share outside of 0..1 have the interval of `means`.
    """
    values = np.asarray(values, dtype=np.float64)
    intervals = shares(values, np.ones_like(values))
    is_outside = ((values < 0) | (values > 1)).any(axis=1)
    if is_outside.any():
        mean_intervals = means(values[is_outside])
        intervals.low[is_outside], intervals.high[is_outside] = mean_intervals.low, mean_intervals.high
    return intervals


def means(values: ArrayLike) -> Intervals:
    """Return the mean over repeats of each cell with its interval.

    The interval is the second-order form of the bootstrap-t interval, without resampling: a cubic transformation
    removes the skewness of the t statistic (Hall 1992, J. R. Stat. Soc. B 54:221). The transformed statistic has
    Student's distribution, with degrees of freedom that account for outliers (as in `shares`).

    Args:
        values: Shape (cells, n).

    Returns:
        Means; without an interval if n is 1.
    """
    values = np.asarray(values, dtype=np.float64)
    n, value = values.shape[1], values.mean(axis=1)
    if n < 2:
        return _no_interval(value)
    deviations = values - value[:, None]
    scale = np.abs(deviations).max(axis=1)
    deviations /= np.where(scale > 0, scale, 1)[:, None]  # prevents underflow of powers of small deviations
    squares, freedom = _squares_and_freedom(deviations)
    skew = (deviations**3).mean(axis=1) / np.where(squares > 0, squares / n, 1) ** 1.5
    skew = np.where(np.abs(skew) < 1e-6, 1e-6, skew)  # approximates the limit at 0 and prevents 0/0
    deviation = scale * np.sqrt(squares / (n - 1))
    quantile = student(freedom) / math.sqrt(n)
    low, high = (
        value - deviation * (np.cbrt(1 + skew * (w - skew / (6 * n))) - 1) / (skew / 3) for w in (quantile, -quantile)
    )
    return Intervals(value, low, high)


def medians(
    values: ArrayLike, least: float = -math.inf, most: float = math.inf, *, upper: ArrayLike | None = None
) -> Intervals:
    """Return the median over repeats of each cell with its interval.

    For six or more repeats, the ends are order statistics: the innermost two that contain the median with a
    probability of at least 95 % for any distribution, computed with a binomial sum (Thompson 1936, Ann. Math. Stat.
    7:122). With fewer repeats, no two order statistics reach 95 %. The interval is then the union of Student's
    interval, which assumes a normal distribution, and the range of the repeats, whose coverage for any distribution
    is `guaranteed_coverage`.

    The value of a right-censored repeat is its lower bound, and its `upper` is infinity. The lower end is computed
    from the lower bounds and the upper end from the upper bounds, so the interval contains the interval that would
    result if all values were known. If one of fewer than six repeats is censored, the interval is the range of the
    repeats.

    Args:
        values: Shape (cells, n).
        least: Smallest possible value, for example 0 for a time.
        most: Largest possible value.
        upper: Upper bound of each value, same shape, infinity if unknown; None if it equals `values`.

    Returns:
        Medians; without an interval if n is 1. An unknown upper end is infinity.
    """
    values = np.asarray(values, dtype=np.float64)
    upper_bounds = values if upper is None else np.asarray(upper, dtype=np.float64)
    n, value = values.shape[1], np.median(values, axis=1)
    if n < 2:
        return _no_interval(value)
    if n < MIN_FOR_ORDER_STATISTICS:
        centre = values.mean(axis=1)
        half = student(np.array(n - 1.0)) * values.std(axis=1, ddof=1) / math.sqrt(n)
        half = np.where((upper_bounds > values).any(axis=1), 0, half)
        low, high = np.minimum(centre - half, values.min(axis=1)), np.maximum(centre + half, upper_bounds.max(axis=1))
        return _containing_value(
            value, np.maximum(low, least), np.where(np.isinf(high), high, np.minimum(high, most))
        )
    rank = _lower_rank(n)
    return _containing_value(
        value,
        np.partition(values, rank - 1, axis=1)[:, rank - 1],
        np.partition(upper_bounds, n - rank, axis=1)[:, n - rank],
    )


def guaranteed_coverage(n: int) -> float:
    """Return the coverage of the interval of a median of n repeats for any distribution.

    The median is outside of the range of the repeats only if all repeats are on the same side of it. The probability
    of this is 2 * 0.5^n.
    """
    return CONFIDENCE if n >= MIN_FOR_ORDER_STATISTICS else 1 - 2.0 ** (1 - n)


def student(freedom: Floats) -> Floats:
    """Return the 97.5 % quantile of Student's t with `freedom` degrees of freedom, 1 or at least 2, of any shape.

    This is Fisher and Cornish's expansion with a fifth term, which makes it exact at 2. The relative error is below
    2e-4 (compared with scipy, which would be a dependency for this function only).
    """
    inverse = 1 / np.asarray(freedom, dtype=np.float64)
    series = NORMAL + inverse * np.polyval((_LAST_TERM, *reversed(_SERIES)), inverse)
    return np.where(inverse == 1, _QUANTILE_1, series)


def _score_interval(share: Floats, trials: Floats, quantile: Floats) -> tuple[Floats, Floats]:
    """Return the ends of the score interval of each share, for a normal or Student's quantile."""
    square = quantile**2 / trials
    centre = (share + square / 2) / (1 + square)
    half = np.sqrt(square * (share * (1 - share) + square / 4)) / (1 + square)
    # For shares of 0 and 1, rounding must not change the ends 0 and 1.
    return np.where(share <= 0, 0.0, centre - half), np.where(share >= 1, 1.0, centre + half)


def _squares_and_freedom(deviations: Floats) -> tuple[Floats, Floats]:
    """Return the sum of squares of deviations, shape (cells, n), and its degrees of freedom.

    These are 2 to n - 1, or 1 if n is 2.
    """
    squares = deviations**2
    total, most = squares.sum(axis=1), deviations.shape[1] - 1
    fourth = (squares**2).sum(axis=1)
    return total, np.minimum(most, 2 * np.divide(total**2, fourth, out=np.full_like(total, most), where=fourth > 0))


@lru_cache(maxsize=1024)
def _lower_rank(n: int) -> int:
    """Return the rank (from 1) of the order statistic that is the lower end of the interval of a median."""
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, n + 1)))])
    tails = np.cumsum(np.exp(logs[n] - logs - logs[::-1] - n * math.log(2)))  # P(at most k of n below the median)
    return int(np.searchsorted(tails, (1 - CONFIDENCE) / 2, side="right"))


def _containing_value(value: Floats, low: Floats, high: Floats) -> Intervals:
    """Return intervals extended to contain their value in spite of rounding errors."""
    return Intervals(value, np.minimum(low, value), np.maximum(high, value))


def _no_interval(value: Floats) -> Intervals:
    return Intervals(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
