"""How far two independent samples are apart: the difference with its interval, its size, and many of them at once."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldkit.analysis.student import NORMAL
from fieldkit.core.model import Interval


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
