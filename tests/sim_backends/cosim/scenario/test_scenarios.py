"""Shipped scenarios load, run with every policy, and give the same run again."""

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.scenario.loading import scenario_files
from sim_backends.cosim.scenario.policies import POLICIES

SECOND_NS = 1_000_000_000


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", scenario_files())
def test_every_scenario_runs_with_every_policy_and_again_the_same(name: str, policy: str) -> None:
    scenario = load_scenario(name)
    runs = [build(scenario, policy=policy).run(SECOND_NS) for _ in range(2)]
    assert runs[0].digest == runs[1].digest
    assert runs[0].fates
