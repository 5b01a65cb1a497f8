"""Number of additional repeats, compared with the intervals that this number gives and with a linear search."""

import math
from itertools import count

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis import sample_size
from fieldkit.analysis.statistics import Intervals, shares
from fieldkit.core.columns import Kind
from fieldkit.core.model import Interval
from tests.helpers.single import additional_repeats, median, share, wilson


def half_width(interval: Interval | None) -> float:
    assert interval is not None
    return (interval.high - interval.low) / 2


@given(st.integers(0, 30), st.integers(1, 30), st.floats(0.01, 0.6))
def test_a_flag_needs_the_number_of_repeats_from_wilsons_formula(
    true_repeats: int, false_repeats: int, expected: float
) -> None:
    n = true_repeats + false_repeats
    p, z = true_repeats / n, scipy.stats.norm.ppf(0.975)
    total = next(
        repeats
        for repeats in count(n)
        if z / (1 + z * z / repeats) * math.sqrt(p * (1 - p) / repeats + (z / repeats) ** 2 / 4)
        <= expected * (1 + 1e-9)
    )
    assert additional_repeats(wilson(true_repeats, n), n, expected, Kind.FLAG) == total - n


@given(st.integers(2, 25), st.floats(0.2, 1.5))
def test_students_quantile_decreases_with_more_repeats(n: int, fraction: float) -> None:
    times = np.random.default_rng(n).normal(10, 1, n)
    interval = median(times)
    present_half_width = half_width(interval)

    def expected(repeats: int) -> float:
        quantile = scipy.stats.t.ppf(0.975, [repeats - 1, n - 1]) if n < 6 else (1, 1)
        return float(present_half_width * quantile[0] / quantile[1] * math.sqrt(n / repeats))

    total = next(
        n_repeats for n_repeats in count(n) if expected(n_repeats) <= fraction * present_half_width * (1 + 2e-4)
    )
    assert interval is not None
    assert additional_repeats(interval, n, fraction * present_half_width, Kind.MEDIAN) == pytest.approx(
        total - n, abs=1
    )


@pytest.mark.parametrize(("rate", "spread"), [(0.02, 40), (0.35, 8), (0.97, 30)])
def test_the_planned_number_gives_the_required_width(rate: float, spread: float) -> None:
    """In the median over cells, because half of them underestimate the final dispersion."""
    random = np.random.default_rng(6)

    def cells(n: int) -> Intervals:
        rates = random.beta(spread * rate, spread * (1 - rate), (400, n))
        return shares(random.binomial(36, rates), np.full((400, n), 36))

    present = cells(20)
    expected = float(np.median(present.high - present.low)) / 2 / 3
    additional = int(np.median(sample_size.additional_repeats(present, 20, expected, Kind.COUNTED)))
    more_cells = cells(20 + additional)
    assert 100 < additional < 260
    assert float(np.median(more_cells.high - more_cells.low)) / 2 == pytest.approx(expected, rel=0.05)


def test_the_planned_repeats_without_losses_give_the_required_width() -> None:
    lossless = share([0] * 20, [36] * 20)
    assert lossless is not None
    additional = additional_repeats(lossless, 20, 0.02, Kind.COUNTED)
    assert wilson(0, 20 + additional).high / 2 <= 0.02 < wilson(0, 20 + additional - 1).high / 2


@pytest.mark.parametrize("kind", list(Kind))
def test_no_more_repeats_are_needed_for_a_narrow_interval(kind: Kind) -> None:
    interval = Interval(0.2, 0.1, 0.4)
    assert additional_repeats(interval, 20, 0.15, kind) == 0
    assert additional_repeats(interval, 20, 5.0, kind) == 0
    assert additional_repeats(interval, 20, 0.1499, kind) == 1


def test_the_number_of_repeats_for_a_tiny_width_is_proportional_to_its_inverse_square() -> None:
    interval = Interval(0.2, 0.1, 0.4)
    thousandth, billionth = (additional_repeats(interval, 20, width, Kind.FLAG) for width in (1e-3, 1e-9))
    assert billionth == pytest.approx(thousandth * 1e12, rel=1e-3)


def test_a_single_repeat_gives_no_number_of_repeats() -> None:
    assert np.isnan(sample_size.additional_repeats(shares([[3]], [[36]]), 1, 0.1, Kind.COUNTED)).all()


def test_an_interval_without_width_is_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        additional_repeats(wilson(1, 2), 2, 0.0, Kind.FLAG)
