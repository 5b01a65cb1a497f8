"""The physics federate in MuJoCo: time, commands, copies, errors, the conformance suite."""

import copy
import json
import math
import sys
from dataclasses import replace

import pytest

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim import load_scenario
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import make_hello
from sim_backends.federates.conformance.probe import Target
from sim_backends.federates.conformance.suite import checks, run_check
from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.handshake import AgentStart, Hello
from sim_backends.federates.named import PythonFederate
from sim_backends.federates.protocols import FederateError
from sim_backends.mujoco_physics.chassis import BURGER, HUSKY, chassis
from sim_backends.mujoco_physics.named import MUJOCO
from sim_backends.mujoco_physics.physics import SERVICE, MujocoPhysics
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.robot_limits import TURTLEBOT3_BURGER
from sim_backends.world.motion import State
from sim_backends.world.world import load_world
from tests.helpers.federate_pairs import HELLO, Pair

COMMANDS = {"ann": Twist(0.5, 0.4), "bob": Twist(-0.3), "cy": Velocity((1.0, 0.5, 0.2), 0.5)}
CONVOY = load_scenario("convoy")
WORLD = load_world(CONVOY.world)
CONVOY_HELLO = make_hello(CONVOY, WORLD, make_bodies(CONVOY, WORLD), 1, PHYSICS)


@pytest.mark.parametrize("name", checks(is_physics=True))
def test_the_mujoco_federate_conforms(name: str) -> None:
    result = run_check(Target(Pair(SERVICE), CONVOY_HELLO, windows=300), name, checks(is_physics=True)[name])
    assert not result.failure, result
    assert bool(result.skipped) == (name == "fork_absence")


@pytest.mark.nightly
def test_a_million_windows_do_not_drift() -> None:
    target = Target(Pair(SERVICE, deadline_s=600.0), CONVOY_HELLO, windows=1_000_000)
    assert not run_check(target, "drift", checks(is_physics=True)["drift"]).failure


@pytest.mark.parametrize("step_ns", [300_000, 1_000_000, 3_000_000, 7_000_000])
def test_the_motion_does_not_depend_on_the_calls(step_ns: int) -> None:
    single_call, many_calls = (MujocoPhysics(replace(HELLO, step_ns=step_ns)) for _ in range(2))
    end_ns = 400_000_000
    for simulation in (single_call, many_calls):
        simulation.advance(0, {})
        simulation.advance(123_456_789, {})
    expected = single_call.advance(end_ns, COMMANDS)
    states = many_calls.advance(123_456_789, COMMANDS)
    for window in range(1, 100):
        states = many_calls.advance(123_456_789 + window * 1_100_001, {})
    assert dict(many_calls.advance(end_ns, {})) == dict(expected)
    assert dict(states) != dict(expected)
    assert math.hypot(*expected["ann"].velocity_m_s) == pytest.approx(0.5, abs=0.05)


def test_a_copy_continues_as_the_original() -> None:
    original = MujocoPhysics(HELLO)
    original.advance(0, COMMANDS)
    original.advance(155_000_000, {})
    original.advance(155_000_000, {"cy": Velocity()})
    copied_physics = copy.deepcopy(original)
    states_before = dict(original.advance(155_000_000, {}))
    expected = dict(copied_physics.advance(400_000_000, {"ann": Twist()}))
    assert dict(original.advance(155_000_000, {})) == states_before
    assert dict(original.advance(400_000_000, {"ann": Twist()})) == expected


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ({"ann": Velocity()}, "a robot on wheels cannot follow"),
        ({"cy": Twist()}, "a quadrotor cannot follow"),
        ({"ann": Twist(math.nan)}, "a robot on wheels cannot follow"),
        ({"cyy": Velocity()}, "a command is for cyy, which is not an agent"),
    ],
)
def test_a_command_that_no_robot_can_follow_is_refused(command: dict[str, object], message: str) -> None:
    simulation = MujocoPhysics(HELLO)
    with pytest.raises(ConfigurationError, match=message):
        simulation.advance(0, command)


def test_an_unstable_simulation_is_an_error_that_names_time_and_agent() -> None:
    simulation = MujocoPhysics(HELLO)
    simulation.advance(20_000_000, {})
    first_dof = simulation.model.joint("a1").dofadr[0]
    simulation.data.qvel[first_dof] = 1e12
    message = r"mujoco became unstable before 0\.03 s \(first agent: bob\)"
    with pytest.raises(FederateError, match=message) as error_info:
        simulation.advance(30_000_000, {})
    assert "shorter step" in error_info.value.remedy


def test_a_missing_mujoco_is_an_error_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "sim_backends.mujoco_physics.physics")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigurationError, match="needs the Python package mujoco") as error_info:
        MUJOCO.load()
    assert error_info.value.remedy.endswith("-m pip install 'fieldkit[mujoco]'")


def test_an_agent_without_a_known_body_has_a_body_of_its_kind_and_size() -> None:
    agents = [
        AgentStart("rover", "rover", State((0.0, 0.0, 0.2))),
        AgentStart("drone", "drone", State((0.0, 3.0, 2.0)), flies=True),
    ]
    states = MujocoPhysics(Hello(PHYSICS, agents)).advance(200_000_000, {})
    assert states["drone"].position_m == pytest.approx((0.0, 3.0, 2.0))
    assert chassis("husky", TURTLEBOT3_BURGER) is HUSKY
    assert chassis("rover", TURTLEBOT3_BURGER) is BURGER
    large = chassis("rover", replace(TURTLEBOT3_BURGER, radius_m=2 * TURTLEBOT3_BURGER.radius_m))
    assert large.wheels.radius_m == 2 * BURGER.wheels.radius_m
    assert large.mass_kg == 8 * BURGER.mass_kg


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step_ns": 0}, "a step of 0 ns is not positive"),
        ({"configuration": b'{"robots": {"ann": {"body": {"speed": 1}}}}'}, "the body of ann is invalid"),
    ],
)
def test_an_impossible_run_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        MujocoPhysics(replace(HELLO, **changes))  # type: ignore[arg-type]


def test_the_entry_point_mujoco_is_a_python_federate() -> None:
    from sim_backends.federates.named import named_federate  # noqa: PLC0415 (its entry point is under test)

    assert isinstance(named_federate("mujoco", PHYSICS), PythonFederate)


def test_an_absent_agent_stays_absent_when_another_is_put_elsewhere() -> None:
    agents = [AgentStart("a", "husky", State((0.0, 0.0, 0.39)), antenna_m=0.39)]
    agents.append(AgentStart("b", "husky", State((5.0, 0.0, 0.39)), antenna_m=0.39))
    scenario = {"scenario": {"agents": {"a": {}, "b": {"appears": "2s"}}}}
    physics = MujocoPhysics(Hello(PHYSICS, agents, step_ns=1_000_000, configuration=json.dumps(scenario).encode()))
    assert physics.advance(0, {}).keys() == {"a"}
    physics.put("a", (1.0, 1.0, 0.0), 0.0)
    assert physics.advance(0, {}).keys() == {"a"}
