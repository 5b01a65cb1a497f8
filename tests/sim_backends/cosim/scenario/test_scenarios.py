"""Shipped scenarios load, run with every policy, and give the same run again, in another process too."""

import json
import os
import subprocess
import sys
from functools import cache

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.run import Run
from sim_backends.cosim.scenario.loading import scenario_files
from sim_backends.cosim.scenario.policies import POLICIES
from tests.helpers.paths import ROOT

SECOND_NS = 1_000_000_000
AGAIN = """
import json, sys
from sim_backends.cosim import build, load_scenario
name, seed, until_ns, *policies = json.loads(sys.argv[1])
runs = [build(load_scenario(name), policy=policy, seed=seed).run(until_ns) for policy in policies]
print(json.dumps([run.digest for run in runs]))
"""


@cache
def one_second(name: str, policy: str) -> Run:
    return build(load_scenario(name), policy=policy).run(SECOND_NS)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("name", scenario_files())
def test_every_scenario_runs_with_every_policy(name: str, policy: str) -> None:
    run = one_second(name, policy)
    assert run.fates
    assert run.windows_ns[-1] == SECOND_NS
    for fate in run.fates.values():
        assert fate.packet.sent_ns <= fate.packet.enters_ns
        if fate.arrived_ns is not None and fate.counted_ns is not None:
            assert fate.packet.enters_ns < fate.arrived_ns <= fate.counted_ns


@pytest.mark.parametrize("name", scenario_files())
def test_another_process_comes_to_the_same(name: str) -> None:
    digests = [one_second(name, policy).digest for policy in POLICIES]
    assert len(set(digests)) > 3
    asked = json.dumps([name, None, SECOND_NS, *POLICIES])
    # Another order of everything that is hashed.
    environment = os.environ | {"PYTHONHASHSEED": "7"}
    done = subprocess.run(
        (sys.executable, "-c", AGAIN, asked),
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=300,
    )
    assert json.loads(done.stdout) == digests


def test_another_seed_gives_another_run() -> None:
    runs = [build(load_scenario("baylands"), seed=seed).run(SECOND_NS // 10) for seed in (1, 2)]
    assert runs[0].digest != runs[1].digest
