"""Intervals against scipy and closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from fieldkit.analysis.statistics import Statistic, bootstrap, wilson

counts = st.integers(1, 10**6).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials)))


@given(counts, st.sampled_from([0.9, 0.95, 0.99]))
def test_wilson_equals_scipy(count: tuple[int, int], confidence: float) -> None:
    events, trials = count
    ours = wilson(events, trials, confidence)
    theirs = stats.binomtest(events, trials).proportion_ci(confidence, method="wilson")
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), rel=1e-9, abs=1e-12)
    assert 0 <= ours.low <= ours.value <= ours.high <= 1


def test_nothing_lost_of_36_still_allows_ten_per_cent() -> None:
    """Field notes; at no event the upper bound is z²/(n + z²)."""
    interval = wilson(0, 36)
    z = stats.norm.ppf(0.975)
    assert (interval.value, interval.low) == (0, 0)
    assert interval.high == pytest.approx(z * z / (36 + z * z))
    assert interval.high == pytest.approx(0.0964, abs=1e-4)


@pytest.mark.parametrize(("events", "trials"), [(0, 0), (-1, 5), (6, 5), (0, -1)])
def test_counts_that_are_none_are_refused(events: int, trials: int) -> None:
    with pytest.raises(ValueError, match="trials"):
        wilson(events, trials)


SAMPLE = tuple(np.random.default_rng(3).lognormal(size=21).tolist())


@pytest.mark.parametrize("statistic", ["mean", "median"])
def test_bootstrap_equals_scipys(statistic: Statistic) -> None:
    ours = bootstrap(SAMPLE, statistic, np.random.default_rng(1), resamples=40_000)
    theirs = stats.bootstrap(
        (SAMPLE,), getattr(np, statistic), n_resamples=40_000, method="percentile", random_state=2
    ).confidence_interval
    assert ours.value == getattr(np, statistic)(SAMPLE)
    width = theirs.high - theirs.low
    assert ours.low == pytest.approx(theirs.low, abs=0.03 * width)
    assert ours.high == pytest.approx(theirs.high, abs=0.03 * width)


def test_bootstrap_of_the_median_meets_its_exact_bounds() -> None:
    """For odd n the resampled median is at most the k-th value if most of n draws are: a binomial tail."""
    n = len(SAMPLE)
    exact = [float(stats.binom.sf(n // 2, n, k / n)) for k in range(n + 1)]
    low = next(k for k in range(n + 1) if exact[k] >= 0.025)
    high = next(k for k in range(n + 1) if exact[k] >= 0.975)
    # No step of the distribution is near a bound, so any seed gives exactly these values.
    assert min(abs(step - bound) for step in exact for bound in (0.025, 0.975)) > 0.005
    interval = bootstrap(SAMPLE, "median", np.random.default_rng(9), resamples=40_000)
    ordered = sorted(SAMPLE)
    assert (interval.low, interval.high) == (ordered[low - 1], ordered[high - 1])


def test_bootstrap_of_the_mean_has_the_width_of_its_standard_error() -> None:
    values = np.random.default_rng(4).normal(size=200)
    interval = bootstrap(values.tolist(), "mean", np.random.default_rng(5))
    half = stats.norm.ppf(0.975) * values.std() / math.sqrt(200)
    assert (interval.high - interval.low) / 2 == pytest.approx(half, rel=0.05)


def test_equal_seeds_give_equal_intervals() -> None:
    first, again, other = (bootstrap(SAMPLE, "mean", np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert first == again != other


@given(st.lists(st.floats(-1e9, 1e9), min_size=2, max_size=30))
def test_bounds_lie_among_the_values(values: list[float]) -> None:
    interval = bootstrap(values, "median", np.random.default_rng(0), resamples=200)
    assert min(values) <= interval.low <= interval.high <= max(values)


@pytest.mark.parametrize("values", [(), (1.0,)])
def test_a_single_value_has_no_interval(values: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="needs two"):
        bootstrap(values, "median", np.random.default_rng(0))
