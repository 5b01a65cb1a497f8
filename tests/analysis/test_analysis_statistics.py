"""Intervals compared with scipy and closed forms. Their coverage is tested in test_coverage.py."""

import numpy as np
import pytest
import scipy
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.analysis.statistics import means, medians, shares, student, wilson_intervals
from fieldkit.core.model import Interval
from tests.helpers.single import mean, mean_share, median, share, wilson

counts = st.integers(1, 10**6).flatmap(lambda trials: st.tuples(st.integers(0, trials), st.just(trials)))
lost_and_sent = st.integers(1, 300).flatmap(lambda n_sent: st.tuples(st.integers(0, n_sent), st.just(n_sent)))
repeats = st.lists(lost_and_sent, min_size=2, max_size=30)
values = st.lists(st.floats(-1e6, 1e6).map(lambda value: round(value, 6)), min_size=2, max_size=30)

BURSTY = np.array([0, 0, 20, 1, 0, 0, 9, 0, 2, 0, 0, 0, 31, 0, 0, 4, 0, 0, 0, 0])
SKEWED = np.random.default_rng(3).gamma(4, size=60)


def not_none(interval: Interval | None) -> Interval:
    assert interval is not None
    return interval


@given(counts)
def test_wilson_equals_scipy(count: tuple[int, int]) -> None:
    events, trials = count
    interval = wilson(events, trials)
    reference = scipy.stats.binomtest(events, trials).proportion_ci(0.95, method="wilson")
    assert (interval.low, interval.high) == pytest.approx((reference.low, reference.high), rel=1e-9, abs=1e-12)
    assert 0 <= interval.low <= interval.value <= interval.high <= 1


def test_no_loss_of_36_packets_has_an_upper_bound_of_ten_percent() -> None:
    """A value from field notes. Without events, the upper bound is z²/(n + z²)."""
    interval = wilson(0, 36)
    z = scipy.stats.norm.ppf(0.975)
    assert (interval.value, interval.low) == (0, 0)
    assert interval.high == pytest.approx(z * z / (36 + z * z))
    assert interval.high == pytest.approx(0.0964, abs=1e-4)


def test_impossible_counts_have_no_interval() -> None:
    intervals = wilson_intervals([-1, 6, 2], [5, 5, 5])
    assert np.isnan(intervals.low).tolist() == np.isnan(intervals.high).tolist() == [True, True, False]


def test_student_equals_scipy() -> None:
    degrees_of_freedom = np.concatenate([[1], np.linspace(2, 30, 281), [100, 1e5]])
    assert student(degrees_of_freedom) == pytest.approx(scipy.stats.t.ppf(0.975, degrees_of_freedom), rel=2e-4)
    assert student(np.array([1, 2])) == pytest.approx(scipy.stats.t.ppf(0.975, [1, 2]), rel=1e-12)


@pytest.mark.parametrize("n_sent", [np.full(20, 36), np.arange(33, 53)], ids=["equal", "unequal"])
def test_the_interval_of_a_share_contains_the_values_that_a_score_test_accepts(n_sent: np.ndarray) -> None:
    """The bounds solve |share - p| = t sqrt(p (1 - p) / trials), found here by bisection."""
    interval = not_none(share(BURSTY, n_sent))
    rate = BURSTY.sum() / n_sent.sum()
    deviations = BURSTY - rate * n_sent
    variance = np.var(deviations, ddof=1) * len(n_sent) / n_sent.sum() ** 2
    trials = rate * (1 - rate) / variance
    t = scipy.stats.t.ppf(0.975, 2 * (deviations**2).sum() ** 2 / (deviations**4).sum())

    def beyond(p: float) -> float:
        return float((rate - p) ** 2 - t * t * p * (1 - p) / trials)

    assert interval.value == rate
    assert interval.low == pytest.approx(scipy.optimize.brentq(beyond, 1e-9, rate), rel=1e-3)
    assert interval.high == pytest.approx(scipy.optimize.brentq(beyond, rate, 1 - 1e-9), rel=1e-3)


def test_bursts_make_the_interval_wider_than_wilsons() -> None:
    bursty, independent = not_none(share(BURSTY, [36] * 20)), wilson(int(BURSTY.sum()), 720)
    assert bursty.low < independent.low < independent.high < bursty.high
    assert bursty.high - bursty.low > 3 * (independent.high - independent.low)


def test_repeats_that_agree_give_nearly_wilsons_interval() -> None:
    """The intervals differ only by the squared ratio of the t quantile to the normal quantile."""
    n_lost = np.random.default_rng(1).binomial(1000, 0.1, size=5000)
    interval, reference = not_none(share(n_lost, [1000] * 5000)), wilson(int(n_lost.sum()), 5_000_000)
    assert (interval.low, interval.high) == pytest.approx((reference.low, reference.high), rel=1e-3)


@pytest.mark.parametrize("n", [2, 3, 20])
def test_a_repeat_counts_as_one_trial_if_all_or_no_packets_are_lost(n: int) -> None:
    assert share([0] * n, [36] * n) == wilson(0, n)
    assert share([36] * n, [36] * n) == wilson(n, n)
    assert mean_share([0.0] * n) == wilson(0, n)


def test_one_repeat_that_lost_everything_gives_a_wide_interval() -> None:
    interval = not_none(share([36] + [0] * 19, [36] * 20))
    assert interval.value == 0.05
    assert 0 < interval.low < 0.005
    assert 0.3 < interval.high < 0.7


@pytest.mark.parametrize(("n_lost", "n_sent"), [(1, 36), (7, 157)])  # the second share is not exact in binary
def test_two_equal_repeats_have_a_wide_interval(n_lost: int, n_sent: int) -> None:
    interval = not_none(share([n_lost, n_lost], [n_sent, n_sent]))
    assert interval.low < interval.value / 5
    assert interval.high > 5 * interval.value


def test_many_small_repeats_and_a_large_one_count_as_few_trials() -> None:
    """Kish: (30 + 19)^2 / (30^2 + 19) trials, not 20."""
    interval = not_none(share([0] * 20, [30] + [1] * 19))
    assert interval.high == pytest.approx(wilson(0, 1000).high * 1000 / (49**2 / 919), rel=0.7)
    assert interval.high > 2 * wilson(0, 20).high


@given(repeats)
def test_the_interval_of_a_share_contains_it(samples: list[tuple[int, int]]) -> None:
    n_lost, n_sent = np.array(samples).T
    interval = not_none(share(n_lost, n_sent))
    assert 0 <= interval.low <= interval.value <= interval.high <= 1
    complement = not_none(share(n_sent - n_lost, n_sent))
    assert (1 - complement.high, 1 - complement.low) == pytest.approx((interval.low, interval.high), abs=1e-9)


@pytest.mark.parametrize("n_lost", [7, 15])
def test_equal_repeats_are_not_distinguished_by_rounding(n_lost: int) -> None:
    """22 times a share of 15/22 is not exactly 15; the losses are then assumed to be independent."""
    interval = not_none(share([n_lost] * 2, [22] * 2))
    assert interval.high - interval.low > 0.5


def test_a_share_outside_its_bounds_has_no_interval() -> None:
    assert share([-187, -3], [22, 22]) is None
    assert share([0, 0], [0, 0]) is None


def test_shares_are_means_if_one_is_outside_of_0_to_1() -> None:
    """A listener that wrote a duplicate has a negative file_loss."""
    assert mean_share([0.1, -0.01, 0.2]) == mean([0.1, -0.01, 0.2])


def test_a_mean_without_skewness_has_students_interval() -> None:
    interval = not_none(mean([1.0, -1.0] * 10))
    reference = scipy.stats.t.interval(0.95, 19, 0, scipy.stats.sem([1.0, -1.0] * 10))
    assert (interval.low, interval.high) == pytest.approx(reference, rel=1e-4)


def test_a_mean_has_the_bootstrap_t_interval() -> None:
    """Computed here by resampling: the mean of each sample divided by its standard error."""
    samples = SKEWED[np.random.default_rng(4).integers(60, size=(40_000, 60))]
    t = (samples.mean(axis=1) - SKEWED.mean()) / scipy.stats.sem(samples, axis=1)
    high, low = SKEWED.mean() - np.quantile(t, (0.025, 0.975)) * scipy.stats.sem(SKEWED)
    interval = not_none(mean(SKEWED))
    assert interval.value == SKEWED.mean()
    assert (interval.low, interval.high) == pytest.approx((low, high), abs=0.05 * (high - low))


@given(values, st.floats(-100, 100), st.floats(0.01, 100))
def test_a_mean_is_shifted_and_scaled_with_its_values(samples: list[float], shift: float, factor: float) -> None:
    original, transformed = not_none(mean(samples)), not_none(mean(shift + factor * np.array(samples)))
    assert original.low <= original.value <= original.high
    size = factor * (np.abs(samples).max() + abs(shift) + 1)
    expected_bounds = (shift + factor * original.low, shift + factor * original.high)
    assert (transformed.low, transformed.high) == pytest.approx(expected_bounds, rel=1e-3, abs=1e-3 * size)


def test_the_mean_of_tiny_values_has_a_tiny_interval() -> None:
    tiny, original = not_none(mean([0, 1e-170, 3e-170])), not_none(mean([0, 1, 3]))
    assert (tiny.low, tiny.high) == pytest.approx((1e-170 * original.low, 1e-170 * original.high), rel=1e-9, abs=0)


@pytest.mark.parametrize("n", [6, 7, 20, 21, 400])
def test_a_median_lies_between_the_two_nearest_order_intervals(n: int) -> None:
    ordered = np.arange(1.0, n + 1)
    interval = not_none(median(ordered[::-1]))
    outer = scipy.stats.quantile_test(ordered, p=0.5).confidence_interval(0.95)
    assert interval.value == np.median(ordered)
    assert outer.low <= interval.low < outer.low + 1
    assert outer.high - 1 < interval.high <= outer.high
    assert interval.low + interval.high == pytest.approx(n + 1)


@pytest.mark.parametrize("n", [2, 3, 5])
def test_the_median_of_few_repeats_has_students_interval_extended_to_all_values(n: int) -> None:
    times = SKEWED[:n]
    low, high = scipy.stats.t.interval(0.95, n - 1, times.mean(), scipy.stats.sem(times))
    interval = not_none(median(times))
    assert (interval.low, interval.high) == pytest.approx(
        (min(low, times.min()), max(high, times.max())), rel=1e-3, abs=1e-3
    )
    assert not_none(median(times, least=0)).low == max(0, interval.low)


@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=30))
@example([0.0, 0.0, 4.6e-169])  # the square of the deviation is 0
@example([0.1] * 3)  # the sum of three is not three times the value
@example([0.7] * 20)
def test_the_interval_of_a_median_contains_it(samples: list[float]) -> None:
    interval = not_none(median(samples))
    assert interval.low <= interval.value <= interval.high


def test_vectorized_cells_equal_single_cells() -> None:
    random = np.random.default_rng(8)
    n_lost, n_sent = random.integers(0, 5, (7, 20)), random.integers(5, 40, (7, 20))
    times = random.lognormal(size=(7, 20))
    for batch, single_cells in (
        (shares(n_lost, n_sent), [share(*cell) for cell in zip(n_lost, n_sent, strict=True)]),
        (means(times), [mean(cell) for cell in times]),
        (medians(times), [median(cell) for cell in times]),
    ):
        rows = zip(batch.value, batch.low, batch.high, strict=True)
        assert [Interval(*map(float, row)) for row in rows] == single_cells


def test_a_single_repeat_has_no_interval() -> None:
    assert [share([1], [36]), mean_share([0.1]), mean([1.0]), median([1.0])] == [None] * 4
