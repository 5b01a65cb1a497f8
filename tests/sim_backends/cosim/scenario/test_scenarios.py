"""Shipped scenarios run with every policy, and reproduce the same run, also in another process."""

import json
import os
import subprocess
import sys

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.cosim.scenario.loading import scenario_files
from tests.helpers.paths import ROOT

SECOND_NS = 1_000_000_000
DIGEST_SCRIPT = """
import json, sys
from sim_backends.cosim import build, load_scenario
until_ns, *pairs = json.loads(sys.argv[1])
runs = [build(load_scenario(name), policy=policy).run(until_ns) for name, policy in pairs]
print(json.dumps([run.digest for run in runs]))
"""


@pytest.mark.parametrize("policy", BUILTIN)
@pytest.mark.parametrize("name", scenario_files())
def test_every_scenario_runs_with_every_policy(name: str, policy: str) -> None:
    run = build(load_scenario(name), policy=policy).run(SECOND_NS)
    assert run.fates
    assert run.windows_ns[-1] == SECOND_NS
    for fate in run.fates.values():
        assert fate.packet.sent_ns <= fate.packet.enters_ns
        if fate.arrived_ns is not None and fate.counted_ns is not None:
            assert fate.packet.enters_ns < fate.arrived_ns <= fate.counted_ns


def test_another_process_gives_the_same_digests() -> None:
    pairs = [(name, policy) for name in scenario_files() for policy in BUILTIN]
    until_ns = SECOND_NS * 6 // 10
    digests = [build(load_scenario(name), policy=policy).run(until_ns).digest for name, policy in pairs]
    assert len(set(digests)) > len(pairs) / 2
    # Another hash seed gives another order of sets.
    environment = os.environ | {"PYTHONHASHSEED": "7"}
    command = sys.executable, "-c", DIGEST_SCRIPT, json.dumps([until_ns, *pairs])
    result = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True, timeout=300
    )
    assert json.loads(result.stdout) == digests


def test_another_seed_gives_another_run() -> None:
    runs = [build(load_scenario("baylands"), seed=seed).run(SECOND_NS // 10) for seed in (1, 2)]
    assert runs[0].digest != runs[1].digest
