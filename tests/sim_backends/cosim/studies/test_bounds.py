"""What a bound costs, against what can be worked out on paper."""

import math

import pytest

from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.programs.periodic import Periodic
from sim_backends.cosim.run import Run
from sim_backends.cosim.studies.bounds import bound_cost
from sim_backends.network.disc import Disc
from sim_backends.physics.paths import Paths
from sim_backends.world.motion import Motion, State, WayPoints

MS = 1_000_000


class Sprint(Motion):
    """Stands for 4 s, and then goes at 2 m/s; it is what its limit lets it do."""

    end_ns = None

    def at(self, time_ns: int) -> dict[str, State]:
        gone_s = max(time_ns / 1e9 - 4, 0.0)
        # It speeds up by 4 m/s^2 for half a second.
        speed_m_s = min(4 * gone_s, 2.0)
        way_m = 2 * gone_s**2 if gone_s < 0.5 else 0.5 + 2 * (gone_s - 0.5)
        return {"a": State((way_m, 0.0, 0.0), (speed_m_s, 0.0, 0.0))}


def sprint(policy: SyncPolicy) -> Run:
    physics = Paths([Sprint(), WayPoints("b", [(9.0, 3.0, 0.0)], 1.0)], limits_m_s2={"a": 4.0})
    agents = Agents(physics, {"a": Periodic("a", "b", period_ns=2_300_001)})
    return Coordinator(agents, Disc(100.0, 10), policy, [("a", "b")]).advance(5_000 * MS)


def test_who_stands_most_of_the_time_needs_few_exchanges() -> None:
    """A fixed window has to be as short as the fastest second needs; the bound spends on that second alone."""
    cost = bound_cost(sprint, 0.1, step_s=0.001)
    assert cost.largest_m <= 0.1
    # At 2 m/s a window of 50 ms keeps 0.1 m; states are those of steps, and packets come every 2.3 ms.
    assert cost.window_s == pytest.approx(0.05, rel=0.07)
    assert cost.fixed_exchanges == pytest.approx(5 / cost.window_s, rel=0.01)
    # Standing, 4 m/s^2 t^2 / 2 = 0.1 m allow 0.22 s, more than the longest window: 0.1 s, 40 of them. At 2 m/s and
    # 4 m/s^2 it is t = 47.7 ms: 47 steps.
    assert 40 + 0.5 / 0.047 < cost.certain.bounded_exchanges < 40 + 1 / 0.047 + 2
    assert cost.factor == pytest.approx(cost.fixed_exchanges / cost.certain.bounded_exchanges)
    assert cost.factor > 1.5
    assert (cost.certain.shortest_s, cost.certain.exchanges) == (0.047, math.ceil(5 / 0.047))
    assert cost.certain.factor == cost.certain.exchanges / cost.certain.bounded_exchanges


def test_a_bound_that_no_fixed_window_of_one_step_keeps_has_no_factor() -> None:
    """A window that does not end at whole steps of the physics is wrong by a step."""
    cost = bound_cost(sprint, 1e-6, step_s=0.0015)
    assert cost.largest_m == 0.0
    assert math.isnan(cost.factor)


def test_the_longest_window_is_taken_where_it_keeps_the_bound() -> None:
    cost = bound_cost(sprint, 1.0, step_s=0.001)
    assert (cost.window_s, cost.fixed_exchanges, cost.certain.bounded_exchanges) == (0.1, 50, 50)
