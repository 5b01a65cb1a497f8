"""As windows shrink, every policy comes to the exact reference, in each shipped scenario."""

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.comparison import errors
from sim_backends.cosim.scenario.loading import scenario_files

UNTIL_NS = 650_000_000
"""Late enough for the first file, and early enough that no small difference decides between arrival and loss."""
MOST_WINDOWS = {"scheduled": 1, "error_bounded": 1, "time_stepped": 2, "sliding_window": 0, "velocity_aware": 0}
"""By how many windows a policy tells an arrival late; an answer to it is later by as many again, and by one at most
where its receiver wakes at a window's end only."""


@pytest.mark.parametrize("name", scenario_files())
def test_errors_are_no_more_than_a_few_windows_whatever_their_length(name: str) -> None:
    for window_us in (1000, 250):
        window_s = window_us / 1e6
        window = {"policy.window": f"{window_us}us", "policy.longest": f"{window_us}us", "physics.step": "250us"}
        scenario = load_scenario(name, window)
        exact = build(scenario).run(UNTIL_NS)
        for policy, late in MOST_WINDOWS.items():
            found = errors(exact, build(scenario, policy=policy).run(UNTIL_NS))
            assert found.packets > 0
            assert found.fate_disagreement == 0, policy
            assert found.delivery_error_s.largest <= (2 * late + (late == 0)) * window_s, policy
            assert found.late_s.largest <= (0 if late else window_s), policy
            # Nobody displaces another faster than the drone and a Husky do.
            assert found.position_error_m.largest <= 2.0 * max(late, 1) * window_s, policy
