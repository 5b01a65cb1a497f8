"""Differences between two conditions: intervals, p-values and effect sizes."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.analysis.statistics import NORMAL
from fieldkit.core.model import Interval


def difference_interval(a: Interval, b: Interval) -> Interval:
    """Return `b - a` with an interval of the same confidence, from the intervals of two independent estimates.

    The distances from the estimates to their bounds are added as squares, separately for each side. For Wilson
    intervals this is Newcombe's tenth method (1998, Stat. Med. 17:873); Zou and Donner (2008, Stat. Med. 27:1693)
    show that it is valid for all estimates with valid intervals. The asymmetry of the intervals is preserved, and the
    coverage is correct even without losses.
    """
    difference = b.value - a.value
    return Interval(
        value=difference,
        low=difference - math.hypot(b.value - b.low, a.high - a.value),
        high=difference + math.hypot(b.high - b.value, a.value - a.low),
    )


def p_value(difference: Interval) -> float:
    """Return the two-sided p-value of a difference, which is below 0.05 if 0 is outside of the interval.

    The length of the 95 % interval on the side of 0 is interpreted as 1.96 standard errors (Altman and Bland 2011,
    BMJ 343:d2304).
    """
    half_width = difference.value - difference.low if difference.value > 0 else difference.high - difference.value
    if difference.value == 0 or half_width <= 0:
        return float(difference.value == 0)
    return math.erfc(abs(difference.value) / half_width * NORMAL / math.sqrt(2))


def holm(p_values: ArrayLike) -> tuple[float, ...]:
    """Return p-values corrected for their number, in the same order (Holm 1979, Scand. J. Stat. 6:65).

    If values below 0.05 are reported as differences, at most 5 % of the comparisons of equal runs contain a false
    report, whatever the dependence between the differences is.
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return tuple(corrected.tolist())


def cliffs_delta(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return the share of pairs in which the value of `b` is larger, minus the share in which it is smaller.

    The result is -1 or 1 if the samples do not overlap, and 0 if each is larger equally often (Cliff 1993, Psychol.
    Bull. 114:494).

    Args:
        a: Shape (n,), n > 0.
        b: Shape (m,), m > 0.
    """
    ordered = np.sort(a)
    below, not_above = (np.searchsorted(ordered, b, side=side).sum() for side in ("left", "right"))
    return float(below + not_above - len(a) * len(b)) / (len(a) * len(b))
