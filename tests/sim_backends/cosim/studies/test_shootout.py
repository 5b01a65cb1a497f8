"""Many policies and seeds beside the reference: the table, and whether a method is biased."""

import math

import numpy as np
import pytest

from sim_backends.cosim.comparison import Errors, Spread, errors, mean_errors
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.policies.scheduled import Scheduled
from sim_backends.cosim.studies.bias import biases
from sim_backends.cosim.studies.outcomes import Outcomes, outcomes
from sim_backends.cosim.studies.shootout import rows
from tests.helpers.moving_pair import DELAY_NS, PAIR_END_NS, PERIOD_NS, SPEED_M_S, WINDOW_S, MovingPair, moving_run

POLICIES = ["scheduled", "velocity_aware_raw", "event_driven", "variable_stepped", "time_stepped"]
SEEDS = [4, 1, 7]


@pytest.fixture(scope="module")
def found() -> Outcomes:
    return outcomes(MovingPair, POLICIES, SEEDS, workers=2)


def told(one: Errors) -> str:
    """Return what does not depend on how fast the machine is."""
    return str([value for name, value in sorted(vars(one).items()) if name not in {"wall_s", "real_time_factor"}])


def test_the_reference_comes_first_and_who_cannot_run_stands_there_with_the_reason(found: Outcomes) -> None:
    table = rows(found)
    assert [row.policy for row in table] == [
        "event_driven",
        "scheduled",
        "velocity_aware_raw",
        "variable_stepped",
        "time_stepped",
    ]
    by_name = {row.policy: row for row in table}
    raw = by_name["velocity_aware_raw"]
    assert raw.errors is None
    assert "b publishes at 0 m/s to a at 1.7 m/s" in raw.failure
    assert "time runs backwards" in raw.failure
    for row in table:
        if row is not raw:
            assert not row.failure
            assert len(row.by_seed) == len(SEEDS)
    for exact in ("event_driven", "variable_stepped"):
        assert all(one.delivery_error_s == Spread(0, 0, 0) for one in by_name[exact].by_seed)
        assert all(one.path_error_m == Spread(0, 0, 0) for one in by_name[exact].by_seed)
    scheduled = by_name["scheduled"].errors
    assert scheduled is not None
    assert scheduled.delivery_error_s.mean == pytest.approx(WINDOW_S / 2, rel=0.02)
    assert scheduled.position_error_m.largest == pytest.approx(SPEED_M_S * WINDOW_S, rel=0.002)
    assert scheduled.exchanges_per_s == pytest.approx(1 / WINDOW_S)


def test_one_worker_and_other_orders_give_the_same_table(found: Outcomes) -> None:
    again = outcomes(MovingPair, POLICIES[::-1], SEEDS[::-1], workers=1)
    for row in rows(found):
        for seed, one in zip(SEEDS, row.by_seed, strict=False):
            assert told(again.errors(row.policy, seed)) == told(one)
            assert again.runs[row.policy][seed].run.digest == found.runs[row.policy][seed].run.digest


def test_the_mean_over_seeds_is_of_means_and_its_largest_the_largest(found: Outcomes) -> None:
    of_seeds = rows(found)[1].by_seed
    both = mean_errors(of_seeds)
    assert both.late_s == Spread(0, 0, 0)
    assert both.delivery_error_s.mean == pytest.approx(np.mean([one.delivery_error_s.mean for one in of_seeds]))
    assert both.delivery_error_s.largest == max(one.delivery_error_s.largest for one in of_seeds)
    assert both.fate_disagreement == pytest.approx(np.mean([one.fate_disagreement for one in of_seeds]))
    assert both.packets == sum(one.packets for one in of_seeds)
    first_s = min(one.first_disagreement_s for one in of_seeds)
    assert both.first_disagreement_s == first_s
    assert both.first_disagreement in {
        one.first_disagreement for one in of_seeds if one.first_disagreement_s == first_s
    }


def test_the_first_disagreement_is_told_with_its_time_and_none_is_nan() -> None:
    reference = moving_run(EventDriven())
    late = errors(reference, moving_run(Scheduled(0.25)))
    # A window begins at 3.5 s, and the border is reached at 3.529.
    assert late.first_disagreement == ("a", -(-3_529_411_765 // PERIOD_NS))
    assert late.first_disagreement_s == pytest.approx(3.529, abs=0.005)
    none = mean_errors([errors(reference, reference)])
    assert none.first_disagreement is None
    assert math.isnan(none.first_disagreement_s)


def test_a_bias_is_told_beside_the_reference_with_how_many_seeds_show_it(found: Outcomes) -> None:
    of = biases(found)
    assert set(of) == {"event_driven", "scheduled", "variable_stepped", "time_stepped"}
    for measure in ("loss", "delay_s", "apart_m"):
        exact = of["variable_stepped"][measure]
        assert (exact.bias.value, exact.deviation, exact.seeds_needed) == (0, 0, None)
    delay_s = of["event_driven"]["delay_s"]
    assert delay_s.mean.value == pytest.approx(DELAY_NS / 1e9)
    added_s = of["scheduled"]["delay_s"].bias
    assert added_s.is_certain
    assert added_s.low < WINDOW_S / 2 < added_s.high
    stepped_s = of["time_stepped"]["delay_s"].bias
    assert stepped_s.value == pytest.approx(1.5 * WINDOW_S - DELAY_NS / 1e9, rel=0.01)
    assert of["time_stepped"]["delay_s"].seeds_needed == 2
    # One comes 1.7 m/s nearer than 10 m.
    times_s = np.arange(0, PAIR_END_NS / 1e9 + 0.05, 0.1)
    assert of["event_driven"]["apart_m"].values == pytest.approx([np.abs(10 - 1.7 * times_s).mean()] * len(SEEDS))
