"""Every policy converges to the exact reference as windows become shorter, in each shipped scenario."""

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.comparison import compare_runs
from sim_backends.cosim.scenario.loading import scenario_files
from tests.helpers.nightly import mark_nightly

UNTIL_NS = 650_000_000
"""Late enough for the first file, and early enough that no packet is at the border between arrival and loss."""
LATE_WINDOWS = {"scheduled": 1, "error_bounded": 1, "time_stepped": 2, "sliding_window": 0, "velocity_aware": 0}
"""Largest delay that a policy adds to an arrival, in windows. A reply has twice that delay; with 0, it may be one
window late if its receiver wakes only at the end of a window."""


CASES = [(name, window_us) for name in scenario_files() for window_us in (1000, 250)]
IN_CI = [case for case in CASES if case[1] == 1000 or case[0] == "convoy"]


@pytest.mark.parametrize("case", mark_nightly(CASES, in_ci=IN_CI), ids=str)
def test_errors_are_at_most_a_few_windows_of_any_length(case: tuple[str, int]) -> None:
    name, window_us = case
    window_s = window_us / 1e6
    window = {"policy.window": f"{window_us}us", "policy.longest": f"{window_us}us", "physics.step": "250us"}
    scenario = load_scenario(name, window)
    exact = build(scenario).run(UNTIL_NS)
    for policy, added_windows in LATE_WINDOWS.items():
        run_errors = compare_runs(exact, build(scenario, policy=policy).run(UNTIL_NS))
        assert run_errors.packets > 0
        assert run_errors.fate_disagreement == 0, policy
        assert run_errors.delivery_error_s.largest <= (2 * added_windows + (added_windows == 0)) * window_s, policy
        assert run_errors.late_s.largest <= (0 if added_windows else window_s), policy
        # The largest relative speed is that of the drone and a Husky.
        assert run_errors.position_error_m.largest <= 2.0 * max(added_windows, 1) * window_s, policy
