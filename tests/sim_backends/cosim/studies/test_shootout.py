"""Many policies and seeds relative to the reference: the table, and the bias of a method."""

import math

import numpy as np
import pytest

from fieldkit.core.executors import Workers
from sim_backends.cosim.comparison import Errors, Spread, compare_runs, mean_errors
from sim_backends.cosim.policies.window_policies import EventDriven, Scheduled
from sim_backends.cosim.studies.shootout import Outcomes, compute_biases, rows, run_outcomes
from tests.helpers.moving_pair import DELAY_NS, PAIR_END_NS, PERIOD_NS, SPEED_M_S, WINDOW_S, MovingPair, moving_run

POLICIES = ["scheduled", "velocity_aware_raw", "event_driven", "variable_stepped", "time_stepped"]
SEEDS = [4, 1, 7]


@pytest.fixture(scope="module")
def all_outcomes() -> Outcomes:
    return run_outcomes(MovingPair, POLICIES, SEEDS, workers=Workers(2))


def reproducible_text(run_errors: Errors) -> str:
    """Return the errors without values that depend on the speed of the machine."""
    values = sorted(vars(run_errors).items())
    return str([value for name, value in values if name not in {"wall_s", "real_time_factor"}])


def test_the_reference_is_first_and_a_policy_that_cannot_run_has_a_reason(all_outcomes: Outcomes) -> None:
    table = rows(all_outcomes)
    assert [row.policy for row in table] == [
        "event_driven",
        "scheduled",
        "velocity_aware_raw",
        "variable_stepped",
        "time_stepped",
    ]
    rows_by_policy = {row.policy: row for row in table}
    raw = rows_by_policy["velocity_aware_raw"]
    assert raw.errors is None
    assert "b publishes at 0 m/s to a at 1.7 m/s" in raw.failure
    assert "time runs backwards" in raw.failure
    for row in table:
        if row is not raw:
            assert not row.failure
            assert len(row.by_seed) == len(SEEDS)
    for exact in ("event_driven", "variable_stepped"):
        assert all(run_errors.delivery_error_s == Spread(0, 0, 0) for run_errors in rows_by_policy[exact].by_seed)
        assert all(run_errors.path_error_m == Spread(0, 0, 0) for run_errors in rows_by_policy[exact].by_seed)
    scheduled = rows_by_policy["scheduled"].errors
    assert scheduled is not None
    assert scheduled.delivery_error_s.mean == pytest.approx(WINDOW_S / 2, rel=0.02)
    assert scheduled.position_error_m.largest == pytest.approx(SPEED_M_S * WINDOW_S, rel=0.002)
    assert scheduled.exchanges_per_s == pytest.approx(1 / WINDOW_S)


def test_one_worker_and_other_orders_give_the_same_table(all_outcomes: Outcomes) -> None:
    reordered = run_outcomes(MovingPair, POLICIES[::-1], SEEDS[::-1], workers=Workers(1))
    for row in rows(all_outcomes):
        for seed, run_errors in zip(SEEDS, row.by_seed, strict=False):
            assert reproducible_text(reordered.errors(row.policy, seed)) == reproducible_text(run_errors)
            digest = all_outcomes.runs[row.policy][seed].run.digest
            assert reordered.runs[row.policy][seed].run.digest == digest


def test_the_mean_over_seeds_has_means_and_the_largest_maximum(all_outcomes: Outcomes) -> None:
    errors_by_seed = rows(all_outcomes)[1].by_seed
    mean = mean_errors(errors_by_seed)
    assert mean.late_s == Spread(0, 0, 0)
    assert mean.delivery_error_s.mean == pytest.approx(
        np.mean([run_errors.delivery_error_s.mean for run_errors in errors_by_seed])
    )
    assert mean.delivery_error_s.largest == max(run_errors.delivery_error_s.largest for run_errors in errors_by_seed)
    assert mean.fate_disagreement == pytest.approx(
        np.mean([run_errors.fate_disagreement for run_errors in errors_by_seed])
    )
    assert mean.packets == sum(run_errors.packets for run_errors in errors_by_seed)
    first_s = min(run_errors.first_disagreement_s for run_errors in errors_by_seed)
    assert mean.first_disagreement_s == first_s
    assert mean.first_disagreement in {
        run_errors.first_disagreement for run_errors in errors_by_seed if run_errors.first_disagreement_s == first_s
    }


def test_the_first_disagreement_has_its_time_and_is_nan_without_one() -> None:
    reference = moving_run(EventDriven())
    late = compare_runs(reference, moving_run(Scheduled(0.25)))
    # A window begins at 3.5 s, and the range limit is reached at 3.529 s.
    assert late.first_disagreement == ("a", -(-3_529_411_765 // PERIOD_NS))
    assert late.first_disagreement_s == pytest.approx(3.529, abs=0.005)
    equal_errors = mean_errors([compare_runs(reference, reference)])
    assert equal_errors.first_disagreement is None
    assert math.isnan(equal_errors.first_disagreement_s)


def test_a_bias_is_relative_to_the_reference_and_has_the_needed_seeds(all_outcomes: Outcomes) -> None:
    biases_by_policy = compute_biases(all_outcomes)
    assert set(biases_by_policy) == {"event_driven", "scheduled", "variable_stepped", "time_stepped"}
    for measure in ("loss", "delay_s", "apart_m"):
        exact = biases_by_policy["variable_stepped"][measure]
        assert (exact.bias.value, exact.deviation, exact.seeds_needed) == (0, 0, None)
    reference_delay = biases_by_policy["event_driven"]["delay_s"]
    assert reference_delay.mean.value == pytest.approx(DELAY_NS / 1e9)
    scheduled_bias = biases_by_policy["scheduled"]["delay_s"].bias
    assert scheduled_bias.excludes_zero
    assert scheduled_bias.low < WINDOW_S / 2 < scheduled_bias.high
    stepped_bias = biases_by_policy["time_stepped"]["delay_s"].bias
    assert stepped_bias.value == pytest.approx(1.5 * WINDOW_S - DELAY_NS / 1e9, rel=0.01)
    assert biases_by_policy["time_stepped"]["delay_s"].seeds_needed == 2
    # The distance is 10 m at first and decreases at 1.7 m/s.
    times_s = np.arange(0, PAIR_END_NS / 1e9 + 0.05, 0.1)
    distances_m = np.abs(10 - 1.7 * times_s)
    assert biases_by_policy["event_driven"]["apart_m"].values == pytest.approx([distances_m.mean()] * len(SEEDS))
