"""Intervals of a single cell; the functions under test compute many at the same time."""

import math

import numpy as np
from numpy.typing import ArrayLike

from fieldkit.analysis import sample_size, statistics
from fieldkit.analysis.statistics import Intervals
from fieldkit.core.columns import Kind
from fieldkit.core.model import Interval


def wilson(events: int, trials: int) -> Interval:
    interval = _single(statistics.wilson_intervals([events], [trials]))
    assert interval is not None
    return interval


def share(lost: ArrayLike, sent: ArrayLike) -> Interval | None:
    return _single(statistics.shares(np.atleast_2d(lost), np.atleast_2d(sent)))


def mean_share(values: ArrayLike) -> Interval | None:
    return _single(statistics.mean_shares(np.atleast_2d(values)))


def mean(values: ArrayLike) -> Interval | None:
    return _single(statistics.means(np.atleast_2d(values)))


def median(values: ArrayLike, least: float = -math.inf) -> Interval | None:
    return _single(statistics.medians(np.atleast_2d(values), least))


def additional_repeats(interval: Interval, n: int, half_width: float, kind: Kind) -> int:
    intervals = Intervals(*(np.array([bound]) for bound in (interval.value, interval.low, interval.high)))
    return int(sample_size.additional_repeats(intervals, n, half_width, kind)[0])


def _single(intervals: Intervals) -> Interval | None:
    value, low, high = float(intervals.value[0]), float(intervals.low[0]), float(intervals.high[0])
    return None if math.isnan(low) else Interval(value=value, low=low, high=high)
