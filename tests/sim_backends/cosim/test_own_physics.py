"""The example physics class `carts.py` runs with every policy, and incomplete physics classes are refused."""

from typing import Any

import pytest

from fieldkit.core.errors import FieldkitError
from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.comparison import compare_runs
from sim_backends.cosim.policies.registry import BUILTIN
from sim_backends.cosim.policies.window_policies import Scheduled
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.cosim.studies.local_errors import local_errors
from sim_backends.federates.frames import PHYSICS
from sim_backends.world.motion import State
from sim_backends.world.world import load_world
from tests.helpers import federate_examples

MS = 1_000_000
SCENARIO = load_scenario("convoy", {"duration": "1s"})
WORLD = load_world(SCENARIO.world)


@pytest.fixture(scope="module")
def carts() -> Any:  # noqa: ANN401 (a class of an example)
    return federate_examples.carts()


def physics(carts: Any) -> Any:  # noqa: ANN401 (as above)
    return carts(make_hello(SCENARIO, WORLD, make_bodies(SCENARIO, WORLD), 1, PHYSICS))


# The paper's rule as printed stops if a subscriber is faster, and the drone is faster from the start.
@pytest.mark.parametrize("policy", sorted({*BUILTIN} - {"velocity_aware_raw"}))
def test_the_documented_class_runs_with_every_policy(policy: str, carts: Any) -> None:  # noqa: ANN401 (as above)
    simulation = build(SCENARIO, policy=policy, physics=physics(carts))
    run = simulation.run(400 * MS)
    assert run.fates
    exact = build(SCENARIO, physics=physics(carts)).run(400 * MS)
    if policy in {"event_driven", "variable_stepped"}:
        assert compare_runs(exact, run).delivery_error_s.largest == 0


def test_the_class_receives_commands_and_forks_do_not_change_it(carts: Any) -> None:  # noqa: ANN401 (as above)
    simulation = build(SCENARIO, physics=physics(carts))
    simulation.run(1000 * MS)
    # The leader is commanded 0.4 m/s, which this physics reaches immediately.
    assert simulation.agents.states(1000 * MS)["leader"].position_m[0] == pytest.approx(20.4, abs=0.001)
    errors_by_policy = local_errors(
        lambda policy: build(SCENARIO, policy=policy, physics=physics(carts)).coordinator,
        {"scheduled": Scheduled},
        (0.01, 0.02),
        [100 * MS, 203 * MS],
    )
    assert errors_by_policy["scheduled"].mean("delivery_s").shape == (2,)


INCOMPLETE = [
    ({"step_ns": None}, r"the physics federate \w+ has no step_ns, an integer above 0 \(it is None\)"),
    ({"step_ns": 1e6}, r"no step_ns, an integer above 0 \(it is 1000000.0\)"),
    ({"step_ns": 0}, "no step_ns, an integer above 0"),
    ({"limits_m_s2": None}, "no limits_m_s2, a mapping from each agent to a number"),
    ({"advance": None}, r"no method advance\(to_ns, commands\)"),
    ({"advance": lambda to_ns, commands: {}}, "has no state of drone, follower, leader"),
    ({"advance": lambda to_ns, commands: dict.fromkeys(SCENARIO.agents, (0, 0, 0))}, "which is not a State"),
    ({"advance": lambda to_ns, commands: None}, "which is not a mapping of states"),
    ({"advance": lambda to_ns: {}}, "physics failed at the request to advance"),
]


@pytest.mark.parametrize(("changes", "message"), INCOMPLETE)
def test_an_incomplete_physics_is_refused_before_the_run(changes: dict[str, Any], message: str, carts: Any) -> None:  # noqa: ANN401
    incomplete_physics = physics(carts)
    vars(incomplete_physics).update(changes)
    with pytest.raises(FieldkitError, match=message):
        build(SCENARIO, physics=incomplete_physics)


def test_a_program_that_drives_requires_states_with_a_heading(carts: Any) -> None:  # noqa: ANN401 (as above)
    incomplete_physics = physics(carts)
    advance = incomplete_physics.advance
    incomplete_physics.advance = lambda to_ns, commands: {
        name: State(state.position_m) for name, state in advance(to_ns, commands).items()
    }
    with pytest.raises(FieldkitError, match="the heading of its robot"):
        build(SCENARIO, physics=incomplete_physics).run()
