"""One-sided bounds compared with scipy, and the coverage of the loss bound with bursty losses."""

import numpy as np
import pytest
import scipy
from hypothesis import assume, given
from hypothesis import strategies as st

from fieldkit.analysis import one_sided_bounds
from tests.analysis.test_coverage import burst_losses


@given(st.integers(0, 200), st.integers(1, 200))
def test_bounds_of_a_share_equal_those_of_clopper_and_pearson(successes: int, repeats: int) -> None:
    assume(successes <= repeats)
    low = 0.0 if successes == 0 else scipy.stats.beta.ppf(0.05, successes, repeats - successes + 1)
    high = 1.0 if successes == repeats else scipy.stats.beta.ppf(0.95, successes + 1, repeats - successes)
    assert one_sided_bounds.share_low(successes, repeats) == pytest.approx(low, abs=1e-9)
    assert one_sided_bounds.share_high(successes, repeats) == pytest.approx(high, abs=1e-9)


@given(st.floats(0.001, 0.9999))
def test_the_number_of_repeats_for_a_share_is_minimal(share: float) -> None:
    n = one_sided_bounds.repeats_for(share)
    assert one_sided_bounds.share_low(n, n) >= share * (1 - 1e-9)
    assert n == 1 or one_sided_bounds.share_low(n - 1, n - 1) < share


def test_29_repeats_are_needed_for_90_percent() -> None:
    """Wilks 1941, Ann. Math. Stat. 12:91: 29 for 90 %, 59 for 95 %, 299 for 99 %."""
    assert [one_sided_bounds.repeats_for(share) for share in (0.9, 0.95, 0.99)] == [29, 59, 299]


@given(st.lists(st.integers(0, 300), min_size=1, max_size=20))
def test_the_loss_bound_is_garwoods_with_the_worst_repeat_as_burst_length(lost_counts: list[int]) -> None:
    burst, total = max([*lost_counts, one_sided_bounds.SHORTEST_BURST]), 1000 * len(lost_counts)
    expected = burst * scipy.stats.gamma.ppf(0.95, sum(lost_counts) / burst + 1) / total
    assert one_sided_bounds.loss_high(lost_counts, [1000] * len(lost_counts)) == pytest.approx(
        min(expected, 1), rel=1e-9
    )


@given(st.lists(st.tuples(st.integers(0, 500), st.integers(0, 500)), min_size=1, max_size=20), st.integers(500, 5000))
def test_fewer_losses_never_make_the_bound_larger(lost_pairs: list[tuple[int, int]], n_sent: int) -> None:
    fewer, more = ([pick(pair) for pair in lost_pairs] for pick in (min, max))
    sizes = [n_sent] * len(lost_pairs)
    assert one_sided_bounds.loss_high(fewer, sizes) <= one_sided_bounds.loss_high(more, sizes) * (1 + 1e-12)
    assert one_sided_bounds.loss_high([0] * len(lost_pairs), sizes) <= one_sided_bounds.loss_high(fewer, sizes)


def test_duplicates_do_not_count_as_negative_losses() -> None:
    assert one_sided_bounds.loss_high([-50, 0], [1000, 1000]) == one_sided_bounds.loss_high([0, 0], [1000, 1000])
    assert one_sided_bounds.loss_high([0], [0]) == 1


@pytest.mark.parametrize("bound", [0.001, 0.02, 0.3])
def test_the_number_of_packets_without_a_loss_is_minimal(bound: float) -> None:
    n = one_sided_bounds.packets_for(bound)
    assert one_sided_bounds.loss_high([0], [n]) < bound <= one_sided_bounds.loss_high([0], [n - 1])


@pytest.mark.parametrize("burst", [0, 1, 5])
@pytest.mark.parametrize("rate", [0.0005, 0.005, 0.02])
def test_the_bound_is_above_the_true_loss_in_95_percent_of_runs(burst: int, rate: float) -> None:
    """6 repeats of 1,250 datagrams on a Gilbert-Elliott link, as an iperf3 test of 3 s."""
    lost_counts = burst_losses(np.random.default_rng(21), rate, burst, (400, 6), 1250)
    coverage = np.mean([one_sided_bounds.loss_high(run, [1250] * 6) >= rate for run in lost_counts])
    assert coverage >= 0.94  # 95 % minus a standard error


@pytest.mark.parametrize("bursts_per_run", [0.5, 3, 20])
def test_bursts_of_the_assumed_length_have_the_stated_coverage(bursts_per_run: float) -> None:
    random = np.random.default_rng(22)
    lost_counts = one_sided_bounds.SHORTEST_BURST * random.poisson(bursts_per_run / 6, (1000, 6))
    rate = one_sided_bounds.SHORTEST_BURST * bursts_per_run / (6 * 1250)
    assert np.mean([one_sided_bounds.loss_high(run, [1250] * 6) >= rate for run in lost_counts]) >= 0.94
