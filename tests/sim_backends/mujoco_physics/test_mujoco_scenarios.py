"""Shipped scenarios with the physics in MuJoCo, compared with the built-in physics."""

import math
from collections.abc import Iterator, Mapping

import pytest

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.scenario.loading import scenario_files
from sim_backends.world.motion import State

SAMPLE_PERIOD_NS = 100_000_000
TOLERANCES_M = {"baylands": 0.02, "convoy": 0.15, "field_30ft": 0.001, "ten_node_mesh": 0.1}
"""Largest distance between a robot in MuJoCo and in the built-in physics; docs/mujoco.md has the differences."""


def states(name: str, physics: str, duration: str) -> Iterator[Mapping[str, State]]:
    """Yield the states at every tenth of a second of a run."""
    scenario = load_scenario(name, {"duration": duration, "physics.federate": physics})
    with build(scenario, policy="sliding_window") as simulation:
        for at_ns in range(SAMPLE_PERIOD_NS, scenario.duration_ns + 1, SAMPLE_PERIOD_NS):
            simulation.run(at_ns)
            yield dict(simulation.agents.physics.advance(at_ns, {}).items())


@pytest.mark.parametrize(
    ("name", "duration"),
    [
        *((name, "1s") for name in scenario_files()),
        *(pytest.param(name, "30s", marks=pytest.mark.nightly) for name in scenario_files()),
    ],
)
def test_robots_move_as_in_the_built_in_physics(name: str, duration: str) -> None:
    for mujoco_states, builtin_states in zip(
        states(name, "mujoco", duration), states(name, "builtin", duration), strict=True
    ):
        for agent, state in mujoco_states.items():
            assert math.dist(state.position_m, builtin_states[agent].position_m) < TOLERANCES_M[name], agent
