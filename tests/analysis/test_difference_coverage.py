"""Coverage of intervals of differences, and rate of false positives for equal runs."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from fieldkit.analysis.significance import difference_interval, holm, p_value
from fieldkit.analysis.statistics import Intervals, medians, shares
from fieldkit.core.model import Interval

Floats = NDArray[np.float64]
Draw = Callable[[np.random.Generator, tuple[int, int]], Floats]

RUNS = 4000
PACKETS = 216


def drifting(loss: float) -> Draw:
    """Return a generator of repeats whose loss has a beta distribution with the mean `loss`."""
    return lambda random, shape: random.binomial(PACKETS, random.beta(1, 1 / loss - 1, shape)).astype(float)


def bursts(loss: float, length: float) -> Draw:
    """Return a generator of repeats with a Poisson number of bursts of geometric length."""

    def draw(random: np.random.Generator, shape: tuple[int, int]) -> Floats:
        count = random.poisson(PACKETS * loss / length, shape)
        n_lost = count + random.negative_binomial(np.maximum(count, 1), 1 / length)
        return np.minimum(PACKETS, np.where(count > 0, n_lost, 0)).astype(float)

    return draw


def independent(loss: float) -> Draw:
    return lambda random, shape: random.binomial(PACKETS, loss, shape).astype(float)


def times(median: float, spread: float) -> Draw:
    return lambda random, shape: median * random.lognormal(0, spread, shape)


def loss_intervals(values: Floats) -> Intervals:
    return shares(values, np.full_like(values, PACKETS))


def differences(a: Intervals, b: Intervals) -> list[Interval]:
    sides = [[Interval(*bounds) for bounds in zip(side.value, side.low, side.high, strict=True)] for side in (a, b)]
    return [difference_interval(first, second) for first, second in zip(*sides, strict=True)]


@cache
def mean(loss: float, length: float) -> float:
    """Return the mean loss of `bursts`. It is below `loss`, because a repeat cannot lose more than all packets."""
    return float(bursts(loss, length)(np.random.default_rng(9), (1, 1_000_000)).mean()) / PACKETS


@pytest.mark.parametrize(
    ("a", "b", "estimates", "true"),
    [
        (drifting(0.08), drifting(0.05), loss_intervals, lambda: -0.03),
        (drifting(0.30), drifting(0.10), loss_intervals, lambda: -0.20),
        (bursts(0.05, 8), bursts(0.02, 8), loss_intervals, lambda: mean(0.02, 8) - mean(0.05, 8)),
        (independent(0.05), bursts(0.05, 8), loss_intervals, lambda: mean(0.05, 8) - 0.05),
        (times(0.010, 0.5), times(0.013, 1.0), medians, lambda: 0.003),
        (times(0.010, 0.2), times(0.013, 1.2), medians, lambda: 0.003),
    ],
    ids=["drift", "heavy", "bursts", "one bursts", "times", "one varies"],
)
def test_intervals_of_differences_of_twenty_repeats_have_the_stated_coverage(
    a: Draw, b: Draw, estimates: Callable[[Floats], Intervals], true: Callable[[], float]
) -> None:
    """`true` is a function because collection must not draw samples."""
    true_difference = true()
    random = np.random.default_rng(1)
    intervals = differences(estimates(a(random, (RUNS, 20))), estimates(b(random, (RUNS, 20))))
    assert (
        0.93
        <= np.mean([interval.low <= true_difference <= interval.high for interval in intervals])
        <= (0.98 if estimates is medians else 0.97)
    )


@pytest.mark.parametrize(
    ("draw", "estimates"),
    [(bursts(0.05, 8), loss_intervals), (drifting(0.05), loss_intervals), (times(0.01, 0.3), medians)],
    ids=["bursts", "drift", "times"],
)
def test_twenty_comparisons_of_equal_runs_have_a_false_positive_in_5_percent(
    draw: Draw, estimates: Callable[[Floats], Intervals]
) -> None:
    random = np.random.default_rng(2)
    intervals = differences(*(estimates(draw(random, (20 * 800, 20))) for _ in "AB"))
    families = np.reshape([p_value(interval) for interval in intervals], (800, 20))
    assert (families.min(axis=1) < 0.05).mean() > 0.3
    assert np.mean([min(holm(family)) < 0.05 for family in families]) < 0.075
