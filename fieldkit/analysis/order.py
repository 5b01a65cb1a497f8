"""Independence of repeats: two rank tests of values in the order of time, for a trend and for runs of alike.

An interval over repeats takes each as an independent draw. Where the place, the weather or a battery changes slowly,
each repeat says again what the one before said, and the interval is too narrow however right its formula is. Both
tests hold for any distribution, ties included: their variances are those over all orders of the values at hand.
"""

from math import erfc, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FEWEST_FOR_TESTS: Final = 10
"""Fewer repeats have too few orders for a test to tell anything among many."""
_FEWEST_VALUES: Final = 5  # the orders of a few values are too coarse for a formula

_erfc = np.frompyfunc(erfc, 1, 1)


def p_values(values: Floats) -> Floats:
    """Return how often repeats in no order at all would be as orderly as these, by the stricter of both tests.

    Twice the smaller p-value (Bonferroni): of a trend up or down, and of neighbours that are alike.

    Args:
        values: Shape (cells, n), in the order of time.

    Returns:
        Shape (cells,); NaN where there are fewer than `FEWEST_FOR_TESTS` repeats, or five different values.
    """
    if values.shape[1] < FEWEST_FOR_TESTS:
        return np.full(len(values), np.nan)
    off = _ranks(values)
    off -= off.mean(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.minimum(2 * np.minimum(2 * _tail(*_trend(off)), _tail(*_alike(off))), 1)
    distinct = (np.diff(np.sort(values, axis=1), axis=1) != 0).sum(axis=1) + 1
    return np.where(distinct < _FEWEST_VALUES, np.nan, found)


def corrected(p_values: Floats) -> Floats:
    """Return p-values corrected for their number, in their order (Benjamini and Hochberg 1995).

    Where those below 0.05 are called, some call is made in about 5 % of the tables of independent repeats (4 to 9 in
    simulations), and of all calls 5 % at most are false in the mean. J. R. Stat. Soc. B 57:289.

    Args:
        p_values: Shape (n,), none NaN.
    """
    rank = np.argsort(p_values, kind="stable")
    scaled = p_values[rank] * len(p_values) / np.arange(1, len(p_values) + 1)
    found = np.empty_like(p_values)
    found[rank] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1)
    return found


def _trend(off: Floats) -> tuple[Floats, Floats]:
    """Return the size of Spearman's correlation of ranks with time, and its variance.

    As a test of trend: Daniels 1950, J. R. Stat. Soc. B 12:171.
    """
    n = off.shape[1]
    time = np.arange(n) - (n - 1) / 2
    correlation = (off @ time) / np.sqrt((off**2).sum(axis=1) * (time**2).sum())
    return np.abs(correlation), np.full(len(off), 1 / (n - 1))


def _alike(off: Floats) -> tuple[Floats, Floats]:
    """Return 1 - half of the rank von Neumann ratio, and its variance (Bartels 1982, J. Am. Stat. Assoc. 77:40).

    The variance is over all orders of the centred ranks x, with S and Q their sums of squares and fourth powers: the
    terms (x_i - x_j)^2 of the sum go by pairs that are the same, share one rank, or none.
    """
    n = off.shape[1]
    s, q = (off**2).sum(axis=1), (off**4).sum(axis=1)
    two, three, four = n * (n - 1), n * (n - 1) * (n - 2), n * (n - 1) * (n - 2) * (n - 3)
    squares, cubes = (s**2 - q) / two, -q / two  # means of x^2 y^2 and x^3 y over different ranks
    pairs, all_four = (2 * q - s**2) / three, (3 * s**2 - 6 * q) / four  # of x^2 y z and x y z w
    same = 2 * q / n - 8 * cubes + 6 * squares
    sharing = 3 * squares + q / n - 4 * cubes
    apart = 4 * (squares - 2 * pairs + all_four)
    second = (n - 1) * same + 2 * (n - 2) * sharing + (n - 2) * (n - 3) * apart
    ratio = (np.diff(off, axis=1) ** 2).sum(axis=1) / s
    return 1 - ratio / 2, (second / s**2 - 4) / 4


def _tail(statistic: Floats, variance: Floats) -> Floats:
    """Return the share above a statistic of mean 0 between -1 and 1, taken as a correlation of that variance.

    It has Student's distribution then, with 1/variance - 1 degrees of freedom, whose tail is a normal one after
    Wallace's transformation (1959, Ann. Math. Stat. 30:1121).
    """
    free = 1 / variance - 1
    size = np.minimum(np.abs(statistic), 1 - 1e-12)
    deviate = np.sqrt(-free * np.log1p(-(size**2))) * (8 * free + 1) / (8 * free + 3)
    tail = np.asarray(_erfc(deviate / sqrt(2)), dtype=np.float64) / 2
    return np.where(statistic >= 0, tail, 1 - tail)


def _ranks(values: Floats) -> Floats:
    """Return the rank of each value among its row, the mean of ranks where several are equal."""
    order = np.argsort(values, axis=1, kind="stable")
    ordered = np.take_along_axis(values, order, axis=1)
    place = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    begins = np.diff(ordered, axis=1, prepend=np.nan) != 0
    first = np.maximum.accumulate(np.where(begins, place, 0), axis=1)
    ends = np.append(begins[:, 1:], np.ones((len(values), 1), dtype=np.bool_), axis=1)
    last = np.minimum.accumulate(np.where(ends, place, values.shape[1])[:, ::-1], axis=1)[:, ::-1]
    ranks = np.empty_like(values, dtype=np.float64)
    np.put_along_axis(ranks, order, (first + last) / 2, axis=1)
    return ranks
