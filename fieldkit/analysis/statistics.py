"""Intervals: of a share from counts, and of a location from repeats."""

import math
from collections.abc import Callable, Mapping, Sequence
from statistics import NormalDist
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.model import Interval

CONFIDENCE: Final = 0.95
RESAMPLES: Final = 10_000
"""Enough that the bounds of two seeds differ by a few per cent of the interval."""

Statistic = Literal["mean", "median"]

_STATISTICS: Final[Mapping[Statistic, Callable[..., NDArray[np.float64]]]] = MappingProxyType(
    {"mean": np.mean, "median": np.median}
)


def wilson(events: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Return the share `events/trials` with its score interval.

    It keeps its coverage near 0 and 1, where lost packets usually are (Wilson 1927, J. Am. Stat. Assoc. 22:209). It
    takes the trials as independent; losses come in bursts, so look at the spread over repeats beside it.

    Raises:
        ValueError: No trials, or not 0 <= events <= trials.
    """
    if trials <= 0 or not 0 <= events <= trials:
        raise ValueError(f"{events} events in {trials} trials")
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    share = events / trials
    scale = 1 / (1 + z * z / trials)
    centre = (share + z * z / (2 * trials)) * scale
    half = z * scale * math.sqrt(share * (1 - share) / trials + (z / (2 * trials)) ** 2)
    # The bounds at 0 and at all are exactly 0 and 1; rounding must not say otherwise.
    low = 0.0 if events == 0 else centre - half
    high = 1.0 if events == trials else centre + half
    return Interval(value=share, low=low, high=high)


def bootstrap(
    values: Sequence[float],
    statistic: Statistic,
    random: np.random.Generator,
    confidence: float = CONFIDENCE,
    resamples: int = RESAMPLES,
) -> Interval:
    """Return the median or mean of `values`, one per repeat, with its percentile bootstrap interval.

    The repeat is the independent unit, so repeats are resampled and not packets (Efron and Tibshirani 1993, An
    Introduction to the Bootstrap, chapter 13).

    Raises:
        ValueError: Fewer than two values: one tells nothing of the spread.
    """
    if len(values) < 2:
        raise ValueError(f"{len(values)} values; an interval needs two")
    of = _STATISTICS[statistic]
    sample = np.asarray(values, dtype=np.float64)
    drawn = sample[random.integers(len(sample), size=(resamples, len(sample)))]
    low, high = np.quantile(of(drawn, axis=1), ((1 - confidence) / 2, (1 + confidence) / 2))
    return Interval(value=float(of(sample)), low=float(low), high=float(high))
