"""Differences of two independent samples compared with published figures, scipy and closed forms."""

import math

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis.significance import cliffs_delta, difference_interval, holm, p_value
from fieldkit.core.model import Interval
from tests.helpers.single import wilson


@pytest.mark.parametrize(
    ("counts", "bounds"),
    [
        ((56, 70, 48, 80), (0.0524, 0.3339)),
        ((9, 10, 3, 10), (0.1705, 0.8090)),
        ((5, 56, 0, 29), (-0.0381, 0.1926)),
        ((0, 10, 0, 20), (-0.1611, 0.2775)),
        ((10, 10, 0, 20), (0.6791, 1.0000)),
    ],
)
def test_the_difference_of_wilson_intervals_has_newcombes_interval(
    counts: tuple[int, int, int, int], bounds: tuple[float, float]
) -> None:
    """Newcombe 1998, Stat. Med. 17:873, table II, row 10."""
    interval = difference_interval(wilson(counts[2], counts[3]), wilson(counts[0], counts[1]))
    assert (interval.low, interval.high) == pytest.approx(bounds, abs=6e-5)


def test_the_difference_of_normal_intervals_has_a_normal_interval() -> None:
    interval = difference_interval(Interval(10, 7, 13), Interval(20, 16, 24))
    assert (interval.value, interval.low, interval.high) == (10, 5, 15)


def test_an_interval_that_ends_at_zero_has_a_p_value_of_5_percent() -> None:
    assert p_value(Interval(2.0, 0.0, 9.0)) == pytest.approx(0.05)
    assert p_value(Interval(-2.0, -9.0, 0.0)) == pytest.approx(0.05)


@given(st.floats(-5, 5).filter(lambda z: abs(z) > 1e-6))
def test_the_p_value_of_a_normal_interval_equals_scipy(z: float) -> None:
    half_width = scipy.stats.norm.ppf(0.975)
    assert p_value(Interval(z, z - half_width, z + half_width)) == pytest.approx(
        2 * scipy.stats.norm.sf(abs(z)), rel=1e-9
    )


@pytest.mark.parametrize(("difference", "p"), [(Interval(0, 0, 0), 1.0), (Interval(1, 1, 1), 0.0)])
def test_an_interval_without_width_is_certain(difference: Interval, p: float) -> None:
    assert p_value(difference) == p


def test_holms_procedure_with_four_p_values() -> None:
    """Calculated by hand: 0.005 * 4, 0.01 * 3, 0.03 * 2, and 0.04, which must not be below the previous value."""
    assert holm((0.01, 0.04, 0.03, 0.005)) == pytest.approx((0.03, 0.06, 0.06, 0.02))


@given(st.lists(st.floats(0, 1), max_size=20))
def test_holm_rejects_the_same_hypotheses_as_the_sequential_procedure(p_values: list[float]) -> None:
    rejected = set()
    for rank, index in enumerate(sorted(range(len(p_values)), key=lambda position: p_values[position])):
        if p_values[index] * (len(p_values) - rank) >= 0.05:
            break
        rejected.add(index)
    assert {index for index, p in enumerate(holm(p_values)) if p < 0.05} == rejected


samples = st.lists(st.integers(0, 8).map(float), min_size=1, max_size=30).map(np.array)


@given(samples, samples)
def test_cliffs_delta_is_scipys_u_statistic_scaled(a: np.ndarray, b: np.ndarray) -> None:
    u = scipy.stats.mannwhitneyu(b, a).statistic
    assert cliffs_delta(a, b) == pytest.approx(2 * u / (len(a) * len(b)) - 1)
    assert cliffs_delta(b, a) == -cliffs_delta(a, b)


def test_cliffs_delta_of_normal_samples_equals_the_closed_form() -> None:
    random = np.random.default_rng(1)
    a, b = random.normal(0, 1, 20_000), random.normal(0.5, 1, 20_000)
    assert cliffs_delta(a, b) == pytest.approx(math.erf(0.5 / 2), abs=0.02)
