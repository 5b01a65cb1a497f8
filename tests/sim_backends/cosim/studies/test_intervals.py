"""Intervals against scipy, and against how often they hold what they shall."""

import math

import numpy as np
import pytest
from scipy import stats

from sim_backends.cosim.studies.intervals import Floats, IntervalEstimate, jackknife, mean, repeats_needed, student


def normal(*shape: int) -> Floats:
    return np.random.default_rng(20).normal(size=shape)


@pytest.mark.parametrize("free", [1, 2, 3, 4, 7, 19, 20, 99, 1000])
def test_students_quantile_is_scipys(free: int) -> None:
    assert student(free) == pytest.approx(stats.t.ppf(0.975, free), rel=1e-9)


def test_a_mean_of_few_repeats_has_students_interval_and_one_alone_none() -> None:
    values = normal(5)
    expected = stats.t.interval(0.95, 4, values.mean(), stats.sem(values))
    found = mean(values)
    assert (found.low, found.high) == pytest.approx(expected)
    assert mean(np.array([3.0])).value == 3.0
    assert math.isnan(mean(np.array([3.0])).low)


@pytest.mark.parametrize(("low", "high", "certain"), [(0.1, 0.3, True), (-0.3, -0.1, True), (-0.1, 0.1, False)])
def test_a_sign_is_certain_where_the_interval_leaves_out_0(low: float, high: float, certain: bool) -> None:
    assert IntervalEstimate((low + high) / 2, low, high).is_certain is certain


def test_the_jackknife_of_a_mean_is_students_interval() -> None:
    values = normal(12)
    without = np.array([np.delete(values, one).mean() for one in range(12)])
    found, expected = jackknife(float(values.mean()), without), mean(values)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize(("difference", "deviation"), [(1.0, 1.0), (0.5, 1.0), (0.2, 1.0), (3.0, 1.5)])
def test_so_many_repeats_show_a_difference_in_four_of_five_studies(difference: float, deviation: float) -> None:
    """Student's noncentral distribution tells the power exactly."""

    def power(count: int) -> float:
        wide, centre = stats.t.ppf(0.975, count - 1), difference / deviation * math.sqrt(count)
        below, above = stats.nct.cdf([-wide, wide], count - 1, centre)
        return float(below + 1 - above)

    count = repeats_needed(difference, deviation)
    assert count is not None
    assert power(count if count > 5 else count + 1) > 0.795
    assert power(max(count - 2, 2)) < 0.82 or count <= 4


def test_no_number_of_repeats_shows_what_is_not_there_and_two_are_always_needed() -> None:
    assert repeats_needed(0.0, 1.0) is None
    assert repeats_needed(5.0, 0.0) == 2
