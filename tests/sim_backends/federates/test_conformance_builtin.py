"""The built-in federates, served by the protocol, pass the conformance suite."""

from dataclasses import replace
from functools import partial

import pytest

from sim_backends.cosim import load_scenario
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.cosim.scenario.served import make_federate
from sim_backends.federates.answering import FederateService
from sim_backends.federates.conformance.probe import Target
from sim_backends.federates.conformance.suite import checks, run_check
from sim_backends.federates.frames import NETWORK, PHYSICS
from sim_backends.world.world import load_world
from tests.helpers.federate_pairs import Pair

SCENARIO = load_scenario("convoy")
WORLD = load_world(SCENARIO.world)
HELLO = make_hello(SCENARIO, WORLD, make_bodies(SCENARIO, WORLD), 1, PHYSICS)
CASES = [(role, check_name) for role in (PHYSICS, NETWORK) for check_name in checks(is_physics=role == PHYSICS)]


@pytest.mark.parametrize(("role", "check_name"), CASES, ids=str)
def test_the_built_in_federates_conform(role: int, check_name: str) -> None:
    service = FederateService(partial(make_federate, role), agents_disappear=True)
    target = Target(Pair(service), replace(HELLO, role=role), windows=500)
    result = run_check(target, check_name, checks(is_physics=role == PHYSICS)[check_name])
    assert not result.failure, result
    assert bool(result.skipped) == (check_name in {"fork_absence", "unknown_transport", "new_agent"})
