"""Intervals at 95 % over independent repeats, in closed form: nothing is resampled, no figure depends on a seed."""

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CONFIDENCE: Final = 0.95
POWER: Final = 0.8
"""How likely a difference that is there shall be seen, by convention."""


@dataclass(frozen=True)
class IntervalEstimate:
    """A number and its interval; nan where there is none.

    Attributes:
        value: The number.
        low: Lower bound.
        high: Upper bound.
    """

    value: float
    low: float
    high: float

    @property
    def is_certain(self) -> bool:
        """Whether the interval leaves out 0, so that the number has a sign."""
        return self.low > 0 or self.high < 0


def mean(values: Floats) -> IntervalEstimate:
    """Return the mean of repeats with Student's interval; fewer than two have none."""
    count = len(values)
    value = float(values.mean()) if count else math.nan
    if count < 2:
        return IntervalEstimate(value, math.nan, math.nan)
    half = student(count - 1) * float(values.std(ddof=1)) / math.sqrt(count)
    return IntervalEstimate(value, value - half, value + half)


def jackknife(value: float, without: Floats) -> IntervalEstimate:
    """Return a statistic of repeats with an interval from what it would be without each of them.

    Args:
        value: The statistic of all repeats.
        without: The statistic of all but one, for each, shape (n,).

    The spread over these is that of the statistic, n - 1 times too small (Efron and Stein 1981, Ann. Stat. 9:586).
    """
    count = len(without)
    if count < 2 or not np.isfinite(without).all():
        return IntervalEstimate(value, math.nan, math.nan)
    error = math.sqrt((count - 1) * float(without.var()))
    half = student(count - 1) * error
    return IntervalEstimate(value, value - half, value + half)


def repeats_needed(difference: float, deviation: float) -> int | None:
    """Return how many pairs of repeats show a difference in four of five studies, None for ever so many.

    That is ((z_0.975 + z_0.8) s / d)^2 + z_0.975^2 / 2, whose second term makes up for the deviation being an
    estimate (Guenther 1981, Am. Stat. 35:243); of few it may be one short.

    Args:
        difference: Mean of the differences within pairs.
        deviation: Their standard deviation.
    """
    if not difference:
        return None
    wide, reached = (NormalDist().inv_cdf(share) for share in ((1 + CONFIDENCE) / 2, POWER))
    return max(math.ceil(((wide + reached) * deviation / difference) ** 2 + wide**2 / 2), 2)


@lru_cache(maxsize=1024)
def student(free: int) -> float:
    """Return the 97.5 % quantile of Student's t with `free` degrees of freedom, at least 1."""
    low, high = 0.0, 13.0  # 12.7 with one degree
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _within(middle, free) < CONFIDENCE else (low, middle)
    return (low + high) / 2


def _within(t: float, free: int) -> float:
    """Return P(|T| < t) (Abramowitz and Stegun 1964, 26.7.3 and 26.7.4, which are finite sums)."""
    angle = math.atan(t / math.sqrt(free))
    sine, square = math.sin(angle), math.cos(angle) ** 2
    term = total = math.cos(angle) if free % 2 else 1.0
    for step in range(2 + free % 2, free - 1, 2):
        term *= square * (step - 1) / step
        total += term
    if free % 2 == 0:
        return sine * total
    return 2 / math.pi * (angle + (sine * total if free > 1 else 0.0))
