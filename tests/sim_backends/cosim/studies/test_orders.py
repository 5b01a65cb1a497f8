"""Orders of all methods over seeds, on several processors."""

import pytest

from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.studies.local_errors import spread_over
from sim_backends.cosim.studies.orders import METHODS, orders
from sim_backends.network.disc import Disc
from tests.helpers.moving_pair import DELAY_NS, PERIOD_NS, RANGE_M, STEP_NS, moving_agents


def make(policy: SyncPolicy, seed: int) -> Coordinator:
    """Return the moving pair; who stands publishes too where the seed is 9, and then time stops for the raw rule."""
    pairs = [("a", "b"), ("b", "a")] if seed == 9 else [("a", "b")]
    return Coordinator(moving_agents(seed * PERIOD_NS // 7), Disc(RANGE_M, DELAY_NS), policy, pairs)


BEGINS = spread_over(4_000_000_000, 7_000_000_000, 5, STEP_NS)


def test_windows_of_all_seeds_count_and_who_has_none_is_told() -> None:
    found = orders(make, (0.001, 0.01), BEGINS, [3, 9], workers=2)
    assert list(found.errors) == [name for name in METHODS if name != "velocity_aware_raw"]
    assert "time runs backwards" in str(found.failures["velocity_aware_raw"])
    assert found.errors["scheduled"].window_s.shape == (2, 10)
    one, other = (orders(make, (0.001, 0.01), BEGINS, [seed], methods=["scheduled"], workers=1) for seed in (3, 9))
    both = [one.errors["scheduled"].sums["position_m"], other.errors["scheduled"].sums["position_m"]]
    assert found.errors["scheduled"].sums["position_m"].sum() == pytest.approx(sum(part.sum() for part in both))


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_the_windows_that_it_was_asked_for_or_comes_near(name: str) -> None:
    lengths_s = orders(make, (0.02, 0.2), BEGINS[:2], [3], methods=[name], workers=1).errors[name].window_s[:, 0]
    assert lengths_s == pytest.approx([0.02, 0.2], rel=0.45)
