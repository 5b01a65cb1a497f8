"""Confidence intervals compared with those of scipy, and the number of repeats that a study needs."""

import math

import numpy as np
import pytest
import scipy

from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, jackknife, mean, repeats_needed, t_quantile


def normal(*shape: int) -> Floats:
    return np.random.default_rng(20).normal(size=shape)


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 7, 19, 20, 99, 1000])
def test_the_quantile_of_students_t_equals_that_of_scipy(degrees: int) -> None:
    assert t_quantile(degrees) == pytest.approx(scipy.stats.t.ppf(0.975, degrees), rel=1e-9)


def test_a_mean_has_students_interval_and_a_single_value_has_none() -> None:
    values = normal(5)
    expected = scipy.stats.t.interval(0.95, 4, values.mean(), scipy.stats.sem(values))
    estimate = mean(values)
    assert (estimate.low, estimate.high) == pytest.approx(expected)
    assert mean(np.array([3.0])).value == 3.0
    assert math.isnan(mean(np.array([3.0])).low)


@pytest.mark.parametrize(("low", "high", "excludes_zero"), [(0.1, 0.3, True), (-0.3, -0.1, True), (-0.1, 0.1, False)])
def test_an_interval_excludes_zero_if_both_bounds_have_one_sign(low: float, high: float, excludes_zero: bool) -> None:
    assert IntervalEstimate((low + high) / 2, low, high).excludes_zero is excludes_zero


def test_the_jackknife_of_a_mean_is_students_interval() -> None:
    values = normal(12)
    means_without_one_value = np.array([np.delete(values, index).mean() for index in range(12)])
    estimate, expected = jackknife(float(values.mean()), means_without_one_value), mean(values)
    assert (estimate.low, estimate.high) == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize(("difference", "deviation"), [(1.0, 1.0), (0.5, 1.0), (0.2, 1.0), (3.0, 1.5)])
def test_the_needed_repeats_detect_a_difference_in_four_out_of_five_studies(
    difference: float, deviation: float
) -> None:
    """The exact power is computed with the noncentral t distribution."""

    def power(count: int) -> float:
        critical_value, centre = scipy.stats.t.ppf(0.975, count - 1), difference / deviation * math.sqrt(count)
        probability_below, probability_above = scipy.stats.nct.cdf(
            [-critical_value, critical_value], count - 1, centre
        )
        return float(probability_below + 1 - probability_above)

    count = repeats_needed(difference, deviation)
    assert count is not None
    assert power(count if count > 5 else count + 1) > 0.795
    assert power(max(count - 2, 2)) < 0.82 or count <= 4


def test_a_difference_of_zero_is_never_detected_and_two_repeats_are_the_minimum() -> None:
    assert repeats_needed(0.0, 1.0) is None
    assert repeats_needed(5.0, 0.0) == 2
