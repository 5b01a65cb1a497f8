"""The claims of the paper: changes computed by hand, and systems that differ only in the claimed property."""

import math
from functools import cache

import numpy as np
import pytest

from fieldkit.core.model import Scenario as Sight
from sim_backends.cosim.studies.intervals import t_quantile
from sim_backends.cosim.studies.paper_claims import Claim, claim_setups, compute_claims, delay_change
from sim_backends.cosim.studies.paper_setups import FlowSample, Setup, only_flow
from sim_backends.cosim.studies.paper_tables import Agreement

NAN = math.nan


@cache
def setups() -> dict[str, Setup]:
    return claim_setups({"duration": "1s"})


def claims_of(
    delays_s: dict[str, list[float]], arrival_counts: dict[str, list[int]]
) -> dict[tuple[str, str, str], Claim]:
    """Return all claims for the mean delays and the arrivals of each system with each seed, the same in every row."""
    samples = {}
    for name, setup in setups().items():
        system = name.partition(",")[0]
        flow = only_flow(setup)
        samples[name] = [
            {flow: FlowSample(100, count, count * delay_s if count else NAN, {})}
            for delay_s, count in zip(delays_s[system], arrival_counts[system], strict=True)
        ]
    return {
        (claim.compared_system, claim.sight_group, claim.quantity): claim
        for claim in compute_claims(setups(), samples)
    }


def test_a_change_compares_means_and_every_row_has_the_same_weight() -> None:
    adaptive_delays_s = np.array([[1.0, 3.0], [0.02, 0.04]])
    compared_delays_s = np.array([[2.0, 2.0], [0.01, 0.005]])
    change, rows = delay_change(adaptive_delays_s, compared_delays_s)
    # From 2 to 2, and from 0.0075 to 0.03: factors of 1 and 4, whose geometric mean is 2.
    assert change.value == pytest.approx(1.0)
    assert rows == 2
    # Without either seed the factors are 1.5 and 8, or 0.5 and 2, whose mean logarithms are log(12) / 2 and 0.
    error = math.log(12) / 4
    assert change.low == pytest.approx(math.expm1(math.log(2) - t_quantile(1) * error))
    assert change.high == pytest.approx(math.expm1(math.log(2) + t_quantile(1) * error))


def test_only_rows_and_seeds_with_arrivals_in_both_systems_are_used() -> None:
    adaptive_delays_s = np.array([[1.0, 9.0, 3.0], [NAN, 1.0, 1.0], [NAN, NAN, NAN]])
    compared_delays_s = np.array([[2.0, NAN, 2.0], [1.0, NAN, 1.0], [1.0, 1.0, 1.0]])
    change, rows = delay_change(adaptive_delays_s, compared_delays_s)
    assert rows == 1
    assert change.value == pytest.approx(0.0)
    undefined_change, rows = delay_change(adaptive_delays_s[2:], compared_delays_s[2:])
    assert rows == 0
    assert math.isnan(undefined_change.value)


def test_claims_equal_those_computed_by_hand() -> None:
    claims_by_key = claims_of(
        {"adaptive": [0.88, 0.88], "fixed window": [1.0, 1.0], "master-based": [0.44, 0.44]},
        {"adaptive": [100, 80], "fixed window": [90, 70], "master-based": [50, 70]},
    )
    assert len(claims_by_key) == 12
    fixed, loss = claims_by_key["fixed window", "all", "delay"], claims_by_key["fixed window", "all", "loss"]
    assert fixed.measured_change.value == pytest.approx(-0.12)
    assert fixed.agreement is Agreement.AGREES
    assert loss.measured_change.value == pytest.approx(-0.10)
    assert loss.agreement is Agreement.AGREES
    assert (fixed.rows, loss.rows) == (10, 10)
    assert math.isnan(fixed.change_in_tables), "no table of the paper has this change"
    master = claims_by_key["master-based", "nlos", "delay"]
    assert master.measured_change.value == pytest.approx(1.0)
    assert master.agreement is Agreement.ABOVE
    # The arrivals differ by 50 and by 10 points with the two seeds.
    assert claims_by_key["master-based", "nlos", "loss"].measured_change.value == pytest.approx(-0.3)
    assert claims_by_key["fixed window", "los", "delay"].agreement is None, "the paper states no change"


def test_the_papers_own_tables_contradict_its_statements() -> None:
    systems = "adaptive", "fixed window", "master-based"
    claims_by_key = claims_of({system: [1.0, 1.0] for system in systems}, {system: [1, 1] for system in systems})
    los, nlos = (claims_by_key["master-based", line, "loss"] for line in Sight)
    assert los.change_in_tables == pytest.approx((20 - 40) / 5 / 100), "losses of 0 0 0 10 10 instead of 0 0 10 10 20"
    assert nlos.change_in_tables == pytest.approx((70 - 140) / 5 / 100)
    delay = claims_by_key["master-based", "los", "delay"]
    expected = (0.01 * 0.1 * 0.4 * 0.4 * 0.6) / (0.01 * 0.1 * 0.48 * 0.6 * 0.8)
    assert delay.change_in_tables == pytest.approx(expected ** (1 / 5) - 1)


def test_adaptive_and_fixed_window_differ_only_by_their_policy() -> None:
    for line in Sight:
        adaptive, fixed = setups()[f"adaptive, {line} 60 m"], setups()[f"fixed window, {line} 60 m"]
        assert adaptive.scenario == fixed.scenario
        assert (adaptive.policy, fixed.policy) == ("velocity_aware", "sliding_window")
        assert adaptive.scenario.policy.window == 0.001, "the paper's initial window"
