"""Computes 95 % confidence intervals over independent repeats without resampling, so no result depends on a seed."""

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
"""Conventional probability of detecting an existing difference."""


@dataclass(frozen=True)
class IntervalEstimate:
    """An estimate and its confidence interval; unknown values are NaN.

    Attributes:
        value: The estimate.
        low: Lower bound.
        high: Upper bound.
    """

    value: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """True if the interval excludes 0, so that the estimate differs significantly from 0."""
        return self.low > 0 or self.high < 0


def mean(values: Floats) -> IntervalEstimate:
    """Return the mean of repeats with Student's t interval; fewer than two repeats have no interval."""
    count = len(values)
    value = float(values.mean()) if count else math.nan
    if count < 2:
        return IntervalEstimate(value, math.nan, math.nan)
    half_width = t_quantile(count - 1) * float(values.std(ddof=1)) / math.sqrt(count)
    return IntervalEstimate(value, value - half_width, value + half_width)


def jackknife(value: float, leave_one_out: Floats) -> IntervalEstimate:
    """Return a statistic of repeats with its jackknife interval.

    The interval is computed from the statistics that omit one repeat each. Their variance is n - 1 times smaller than
    the variance of the statistic itself (Efron and Stein 1981, Ann. Stat. 9:586). There is no interval if there are
    fewer than two repeats, or if one of these statistics is not finite.

    Args:
        value: The statistic of all n repeats.
        leave_one_out: For each repeat, the statistic of all other repeats, shape (n,).
    """
    count = len(leave_one_out)
    if count < 2 or not np.isfinite(leave_one_out).all():
        return IntervalEstimate(value, math.nan, math.nan)
    error = math.sqrt((count - 1) * float(leave_one_out.var()))
    half_width = t_quantile(count - 1) * error
    return IntervalEstimate(value, value - half_width, value + half_width)


def repeats_needed(difference: float, deviation: float) -> int | None:
    """Return the number of pairs of repeats that detect a difference in four of five studies, at least 2.

    It is ((z_0.975 + z_0.8) s / d)^2 + z_0.975^2 / 2; the second term is a correction, because the deviation is an
    estimate (Guenther 1981, Am. Stat. 35:243). Small numbers may be one too low. Return None if the difference is 0.

    Args:
        difference: Mean of the differences within pairs.
        deviation: Their standard deviation.
    """
    if not difference:
        return None
    z_interval, z_power = (NormalDist().inv_cdf(share) for share in ((1 + CONFIDENCE) / 2, POWER))
    return max(math.ceil(((z_interval + z_power) * deviation / difference) ** 2 + z_interval**2 / 2), 2)


@lru_cache(maxsize=1024)
def t_quantile(degrees: int) -> float:
    """Return the 97.5 % quantile of Student's t distribution with at least 1 degree of freedom."""
    low, high = 0.0, 13.0  # the quantile for one degree is 12.7
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if _probability_within(middle, degrees) < CONFIDENCE else (low, middle)
    return (low + high) / 2


def _probability_within(t: float, degrees: int) -> float:
    """Return P(|T| < t) (Abramowitz and Stegun 1964, 26.7.3 and 26.7.4, which are finite sums)."""
    angle = math.atan(t / math.sqrt(degrees))
    sine, square = math.sin(angle), math.cos(angle) ** 2
    term = total = math.cos(angle) if degrees % 2 else 1.0
    for step in range(2 + degrees % 2, degrees - 1, 2):
        term *= square * (step - 1) / step
        total += term
    if degrees % 2 == 0:
        return sine * total
    return 2 / math.pi * (angle + (sine * total if degrees > 1 else 0.0))
