"""The cost of a bound, compared with results computed by hand."""

import math

import pytest

from sim_backends.cosim import load_scenario
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.commands import bound
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.run_record import Run
from sim_backends.cosim.studies.bounds import BoundCost, FixedCost, bound_cost, longest_sufficient_window
from sim_backends.network.disc import Disc
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import Motion, State, WayPoints

MS = 1_000_000


class LateStart(Motion):
    """Does not move for 4 s, and then moves at 2 m/s; it accelerates at its limit."""

    end_ns = None

    def at(self, time_ns: int) -> dict[str, State]:
        moving_s = max(time_ns / 1e9 - 4, 0.0)
        # It accelerates at 4 m/s^2 for half a second.
        speed_m_s = min(4 * moving_s, 2.0)
        distance_m = 2 * moving_s**2 if moving_s < 0.5 else 0.5 + 2 * (moving_s - 0.5)
        return {"a": State((distance_m, 0.0, 0.0), (speed_m_s, 0.0, 0.0))}


def run_late_start(policy: SyncPolicy) -> Run:
    physics = Paths([LateStart(), WayPoints("b", [(9.0, 3.0, 0.0)], 1.0)], limits_m_s2={"a": 4.0})
    agents = Agents(physics, {"a": Periodic("a", "b", period_ns=2_300_001)})
    return Coordinator(agents, Disc(100.0, 10, extrapolates=True), policy, [("a", "b")]).advance(5_000 * MS)


def test_an_agent_with_a_mostly_constant_velocity_needs_few_exchanges() -> None:
    """A fixed window must be short enough for the fastest second; the bound only limits changes of the velocity."""
    cost = bound_cost(run_late_start, 0.01, step_s=0.001)
    assert cost.largest_m <= 0.01
    # At 2 m/s, the error of a window of 5 ms is 10 mm; states change at steps, and packets are sent every 2.3 ms.
    assert cost.window_s == pytest.approx(0.005, rel=0.2)
    assert cost.fixed_exchanges == pytest.approx(5 / cost.window_s, rel=0.01)
    # During half a second of 4 m/s^2, the bound allows windows of t = 70.7 ms: 4 m/s^2 t^2 / 2 = 10 mm. All others
    # last 0.1 s.
    assert 45 + 0.5 / 0.0708 <= cost.exchanges <= 45 + 0.5 / 0.068 + 2
    assert cost.factor == cost.fixed_exchanges / cost.exchanges
    assert cost.factor > 15


def test_a_bound_that_no_fixed_window_satisfies_has_no_factor() -> None:
    """A window that does not end at whole steps of the physics has an error of a step."""
    cost = bound_cost(run_late_start, 1e-6, step_s=0.0015)
    assert cost.largest_m <= 1e-6
    assert math.isnan(cost.factor)


def test_the_longest_window_is_the_result_if_it_satisfies_the_bound() -> None:
    cost = bound_cost(run_late_start, 1.0, step_s=0.001)
    assert (cost.window_s, cost.fixed_exchanges, cost.exchanges) == (0.1, 50, 50)


def test_the_window_for_all_runs_satisfies_the_bound_in_each_run() -> None:
    """The second run has an error of 2 m/s times the window, except, by chance, between 10 and 11 ms."""

    def costs(window_s: float) -> list[FixedCost]:
        second_error_m = 0.0 if 0.01 < window_s < 0.011 else 2 * window_s
        return [FixedCost(window_s, round(1 / window_s)), FixedCost(second_error_m, round(1 / window_s))]

    window_s, fixed = longest_sufficient_window([0.017, 0.0105], costs, 0.0105)
    assert fixed == costs(window_s)
    assert window_s == 0.0105
    window_s, fixed = longest_sufficient_window([0.009, 0.0105], costs, 0.0105)
    assert 0.00525 / 1.02 <= window_s <= 0.00525
    assert [cost.exchanges for cost in fixed] == [round(1 / window_s)] * 2
    assert longest_sufficient_window([0.01, math.nan], costs, 0.01)[1] == ()


@pytest.mark.parametrize(
    ("largest_m", "outcome"),
    [(0.01, "keeps the bound of 10 mm"), (0.02, "exceeds the bound of 10 mm (largest error 20 mm)")],
)
def test_the_summary_states_if_the_bound_was_exceeded(largest_m: float, outcome: str) -> None:
    cost = BoundCost(largest_m, exchanges=7, added_s=math.nan, window_s=math.nan, fixed_exchanges=0)
    text = bound._summary(load_scenario("field_30ft"), [cost], math.nan, ()).replace("\n", " ")
    assert text == f"error_bounded {outcome} with 7 exchanges, and no fixed window keeps the bound"
