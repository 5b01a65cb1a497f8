"""Statistics over repeats, all intervals at 95 %: shares, means and medians, and how far two samples are apart.

What is over repeats takes each repeat as one independent draw, whatever goes on inside it. All is in closed form and
vectorized over cells. Nothing is resampled, so no figure depends on a seed. Coverage: docs/method-intervals.md.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.core.model import Interval

Floats = NDArray[np.float64]

CONFIDENCE: Final = 0.95
"""Of all intervals."""

NORMAL: Final = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
"""The normal distribution's 97.5 % quantile, which has as much above it as is missed on one side."""

_ONE: Final = math.tan(math.pi * CONFIDENCE / 2)
_TWO: Final = CONFIDENCE * math.sqrt(2 / (1 - CONFIDENCE**2))
# Abramowitz and Stegun 1964, 26.7.5.
_SERIES: Final = (
    (NORMAL**3 + NORMAL) / 4,
    (5 * NORMAL**5 + 16 * NORMAL**3 + 3 * NORMAL) / 96,
    (3 * NORMAL**7 + 19 * NORMAL**5 + 17 * NORMAL**3 - 15 * NORMAL) / 384,
    (79 * NORMAL**9 + 776 * NORMAL**7 + 1482 * NORMAL**5 - 1920 * NORMAL**3 - 945 * NORMAL) / 92160,
)
_REST: Final = 32 * (_TWO - NORMAL - sum(term / 2**power for power, term in enumerate(_SERIES, 1)))
FEWEST_FOR_ORDER: Final = 6  # with five values even the smallest and the largest enclose the median in 93.75 % only
_ROUNDING: Final = 1e-12  # repeats that lost the same share are apart by less


@dataclass(frozen=True, eq=False)
class Intervals:
    """Estimates of many cells with their intervals.

    Attributes:
        value: The estimates, shape (cells,).
        low: Lower bounds; NaN where there is no interval.
        high: Upper bounds.
    """

    value: Floats
    low: Floats
    high: Floats


def wilsons(events: ArrayLike, trials: ArrayLike) -> Intervals:
    """Return of each cell the share `events/trials` with its score interval.

    It keeps its coverage near 0 and 1, where lost packets usually are (Wilson 1927, J. Am. Stat. Assoc. 22:209). It
    takes the trials as independent; losses come in bursts: `shares` is for them.

    Args:
        events: Shape (cells,).
        trials: Of how many, above zero, same shape.

    Returns:
        No interval where there are more events than trials, or fewer than none.
    """
    events, trials = np.asarray(events, dtype=np.float64), np.asarray(trials, dtype=np.float64)
    value, known = events / trials, (events >= 0) & (events <= trials)
    low, high = _score(np.where(known, value, 0), trials, np.full_like(value, NORMAL))
    return Intervals(value, np.where(known, low, np.nan), np.where(known, high, np.nan))


def shares(lost: ArrayLike, sent: ArrayLike) -> Intervals:
    """Return of each cell the share lost of all that was sent, with an interval that knows of bursts.

    The share is a ratio of sums over repeats, whose variance is linearized over repeats (Cochran 1977, Sampling
    Techniques, 6.4). What was sent is worth as many independent trials as would have that variance; their score
    interval, with a t quantile, is the one (Korn and Graubard 1998, Survey Methodology 24:193, on Wilson's interval;
    Franco, Little, Louis and Slud 2019, J. Surv. Stat. Methodol. 7:334). The degrees of freedom are those that the
    fourth moment of the repeats leaves to the variance (Satterthwaite 1946, Biometrics Bull. 2:110): where one repeat
    has nearly all losses it is nearly the only one that speaks.

    Where no repeat lost anything, or all lost everything, nothing tells how losses burst, and each repeat counts as a
    trial of its own, as in `wilsons`.

    Args:
        lost: Things lost by each repeat, shape (cells, n).
        sent: Of how many, same shape.

    Returns:
        No interval for n = 1, and none where the share is outside 0..1.
    """
    lost, sent = np.asarray(lost, dtype=np.float64), np.asarray(sent, dtype=np.float64)
    n, total = lost.shape[1], sent.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = lost.sum(axis=1) / total
        off = lost - value[:, None] * sent
        apart, free = _scatter(np.where(np.abs(off) > _ROUNDING * sent, off, 0))
        trials = value * (1 - value) * total**2 * (n - 1) / (n * apart)
        # Repeats that agree do not make losses certain: then as if losses were independent.
        trials = np.where(apart > 0, trials, total)
        alone = total**2 / (sent**2).sum(axis=1)  # Kish 1965, Survey Sampling, 11.7: n if all sent the same
        some = (value > 0) & (value < 1)
        low, high = _score(value, np.where(some, trials, alone), np.where(some, student(free), NORMAL))
    known = (n > 1) & (value >= 0) & (value <= 1)
    return Intervals(value, np.where(known, low, np.nan), np.where(known, high, np.nan))


def mean_shares(values: ArrayLike) -> Intervals:
    """Return of each cell the mean of shares, one per repeat: `shares` in which each repeat counts the same.

    Better than `means`, because a share has bounds: repeats that lost nothing leave room for losses.

    Args:
        values: Shape (cells, n).

    Returns:
        As `means` in cells where some share is outside 0..1.
    """
    values = np.asarray(values, dtype=np.float64)
    found = shares(values, np.ones_like(values))
    beyond = ((values < 0) | (values > 1)).any(axis=1)
    if beyond.any():
        others = means(values[beyond])
        found.low[beyond], found.high[beyond] = others.low, others.high
    return found


def means(values: ArrayLike) -> Intervals:
    """Return of each cell the mean over repeats with its interval.

    The second-order form of the bootstrap-t interval, without its draws: a cubic takes the skewness out of the t
    statistic (Hall 1992, J. R. Stat. Soc. B 54:221), and what is left has Student's distribution, with the degrees of
    freedom that outliers leave (as `shares`).

    Args:
        values: Shape (cells, n).

    Returns:
        No interval for n = 1.
    """
    values = np.asarray(values, dtype=np.float64)
    n, value = values.shape[1], values.mean(axis=1)
    if n < 2:
        return _without(value)
    off = values - value[:, None]
    scale = np.abs(off).max(axis=1)
    off /= np.where(scale > 0, scale, 1)[:, None]  # else the powers of tiny deviations are 0
    apart, free = _scatter(off)
    skew = (off**3).mean(axis=1) / np.where(apart > 0, apart / n, 1) ** 1.5
    skew = np.where(np.abs(skew) < 1e-6, 1e-6, skew)  # the limit at 0, away from 0/0
    deviation = scale * np.sqrt(apart / (n - 1))
    reach = student(free) / math.sqrt(n)
    low, high = (
        value - deviation * (np.cbrt(1 + skew * (w - skew / (6 * n))) - 1) / (skew / 3) for w in (reach, -reach)
    )
    return Intervals(value, low, high)


def medians(
    values: ArrayLike, least: float = -math.inf, most: float = math.inf, *, upper: ArrayLike | None = None
) -> Intervals:
    """Return of each cell the median over repeats with its interval.

    From six repeats on from one order statistic to another, the innermost two that hold the median in 95 % whatever
    the distribution is, by a binomial sum (Thompson 1936, Ann. Math. Stat. 7:122). With fewer no two values are far
    enough apart: then Student's interval, which takes the repeats as normal, and all of the repeats, which together
    hold it in `assured` at least.

    A repeat of which only a lower bound is known (it is censored) has that as its value, and infinity as `upper`. The
    lower end is that of the lower bounds and the upper end that of the upper ones, so that the interval holds what it
    would hold if all were known. With fewer than six repeats it is then that of all repeats alone.

    Args:
        values: Shape (cells, n).
        least: What no value can be below: 0 for a time.
        most: What none can be above.
        upper: The largest that each value can be, same shape, infinity where that is not known; None for the values.

    Returns:
        No interval for n = 1; infinity for an upper end that is not known.
    """
    values = np.asarray(values, dtype=np.float64)
    tops = values if upper is None else np.asarray(upper, dtype=np.float64)
    n, value = values.shape[1], np.median(values, axis=1)
    if n < 2:
        return _without(value)
    if n < FEWEST_FOR_ORDER:
        centre = values.mean(axis=1)
        half = student(np.array(n - 1.0)) * values.std(axis=1, ddof=1) / math.sqrt(n)
        half = np.where((tops > values).any(axis=1), 0, half)
        low, high = np.minimum(centre - half, values.min(axis=1)), np.maximum(centre + half, tops.max(axis=1))
        return _around(value, np.maximum(low, least), np.where(np.isinf(high), high, np.minimum(high, most)))
    rank = _rank(n)
    return _around(
        value,
        np.partition(values, rank - 1, axis=1)[:, rank - 1],
        np.partition(tops, n - rank, axis=1)[:, n - rank],
    )


def assured(n: int) -> float:
    """Return in which share of cases the interval of a median of n repeats holds it, whatever their distribution.

    That of all repeats together misses it only where all are on one side of it.
    """
    return CONFIDENCE if n >= FEWEST_FOR_ORDER else 1 - 2.0 ** (1 - n)


def between(a: Interval, b: Interval) -> Interval:
    """Return `b - a` with an interval of the same confidence, made from those of two independent estimates.

    The distance from each estimate to its own bound stands for its spread on that side, and the two add as squares.
    For Wilson intervals this is Newcombe's tenth method (1998, Stat. Med. 17:873); Zou and Donner (2008, Stat. Med.
    27:1693) show that it holds for any estimate whose own intervals do. A skewed interval gives a skewed difference,
    and one that is right at 0 lost stays right.
    """
    difference = b.value - a.value
    return Interval(
        value=difference,
        low=difference - math.hypot(b.value - b.low, a.high - a.value),
        high=difference + math.hypot(b.high - b.value, a.value - a.low),
    )


def p_value(difference: Interval) -> float:
    """Return how often chance alone gives a difference so large, two-sided: below 0.05 where 0 is outside.

    The half of the 95 % interval that reaches towards 0 is taken as 1.96 standard errors (Altman and Bland 2011, BMJ
    343:d2304).
    """
    reach = difference.value - difference.low if difference.value > 0 else difference.high - difference.value
    if difference.value == 0 or reach <= 0:
        return float(difference.value == 0)
    return math.erfc(abs(difference.value) / reach * NORMAL / math.sqrt(2))


def holm(p_values: ArrayLike) -> tuple[float, ...]:
    """Return p-values corrected for their number, in the order given (Holm 1979, Scand. J. Stat. 6:65).

    Where those below 0.05 are called differences, any call at all is false in at most 5 % of the comparisons of runs
    that do not differ, however the single differences depend on each other.
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return tuple(corrected.tolist())


def cliffs_delta(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the share of pairs in which the value of `b` is the larger, less that in which it is the smaller.

    -1 and 1: the samples do not overlap; 0: each is the larger as often (Cliff 1993, Psychol. Bull. 114:494).

    Args:
        a: Shape (n,), n > 0.
        b: Shape (m,), m > 0.
    """
    ordered = np.sort(a)
    below, not_above = (np.searchsorted(ordered, b, side=side).sum() for side in ("left", "right"))
    return float(below + not_above - len(a) * len(b)) / (len(a) * len(b))


def student(free: Floats) -> Floats:
    """Return the 97.5 % quantile of Student's t with `free` degrees of freedom, 1 or at least 2, of any shape.

    Fisher and Cornish's expansion, with a fifth term that makes it exact at 2: right to 2 in 10,000 (scipy's). It
    spares a dependency on scipy, of which nothing else is needed.
    """
    inverse = 1 / np.asarray(free, dtype=np.float64)
    series = NORMAL + inverse * np.polyval((_REST, *reversed(_SERIES)), inverse)
    return np.where(inverse == 1, _ONE, series)


def _score(share: Floats, trials: Floats, quantile: Floats) -> tuple[Floats, Floats]:
    square = quantile**2 / trials
    centre = (share + square / 2) / (1 + square)
    half = np.sqrt(square * (share * (1 - share) + square / 4)) / (1 + square)
    # The bounds at 0 and at all are exactly 0 and 1; rounding must not say otherwise.
    return np.where(share <= 0, 0.0, centre - half), np.where(share >= 1, 1.0, centre + half)


def _scatter(off: Floats) -> tuple[Floats, Floats]:
    """Return the sum of squares of deviations (cells, n), and its degrees of freedom: n - 1 at most, 2 at least."""
    squares = off**2
    apart, most = squares.sum(axis=1), off.shape[1] - 1
    fourth = (squares**2).sum(axis=1)
    return apart, np.minimum(most, 2 * np.divide(apart**2, fourth, out=np.full_like(apart, most), where=fourth > 0))


@lru_cache(maxsize=1024)
def _rank(n: int) -> int:
    """Return the rank, from 1, of the lower end of the interval of a median."""
    logs = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, n + 1)))])
    tails = np.cumsum(np.exp(logs[n] - logs - logs[::-1] - n * math.log(2)))  # P(at most k of n below the median)
    return int(np.searchsorted(tails, (1 - CONFIDENCE) / 2, side="right"))


def _around(value: Floats, low: Floats, high: Floats) -> Intervals:
    """Return intervals that hold their value, which rounding denies where all repeats are equal, or next to 0."""
    return Intervals(value, np.minimum(low, value), np.maximum(high, value))


def _without(value: Floats) -> Intervals:
    return Intervals(value, np.full_like(value, np.nan), np.full_like(value, np.nan))
