"""Motion in MuJoCo compared with closed forms: falls, drives, turns, braking, slopes, walls, flights, and rest."""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from sim_backends.federates.frames import PHYSICS
from sim_backends.federates.handshake import AgentStart, Hello
from sim_backends.mujoco_physics.chassis import HUSKY
from sim_backends.mujoco_physics.physics import MujocoPhysics
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.robot_limits import HUSKY_A200
from sim_backends.world.motion import GRAVITY_M_S2, State

WALL: Mapping[str, object] = {
    "name": "wall",
    "kind": "wall",
    "from_m": [3, -40],
    "to_m": [3, 40],
    "height": "2m",
    "thickness": "0.2m",
    "material": "brick",
}
WALL_EAST_M = 2.9


def ramp(degrees: float, length_m: float, centre_m: float = 0.0) -> dict[str, object]:
    """Return a ramp that rises eastwards."""
    rise_m = length_m * math.tan(math.radians(degrees))
    return {"name": "ramp", "kind": "ramp", "centre_m": [centre_m, 0], "size_m": [length_m, 20, rise_m]}


def physics(
    *agents: AgentStart, obstacles: Sequence[Mapping[str, object]] = (), bodies: Mapping[str, Any] | None = None
) -> MujocoPhysics:
    """Return a simulation with steps of 1 ms."""
    world = {
        "name": "test",
        "summary": "",
        "area_m": [100, 100],
        "obstacles": [dict(obstacle) for obstacle in obstacles],
    }
    robots = {name: {"body": body} for name, body in (bodies or {}).items()}
    return MujocoPhysics(
        Hello(PHYSICS, agents, configuration=json.dumps({"world": world, "robots": robots}).encode())
    )


def husky(name: str = "husky", east_m: float = 0.0, north_m: float = 0.0, up_m: float = 0.0) -> AgentStart:
    return AgentStart(name, "husky", State((east_m, north_m, up_m + 0.39), heading_rad=0.0), False, 0.39)


def burger(name: str = "burger", east_m: float = 0.0, north_m: float = 3.0, up_m: float = 0.0) -> AgentStart:
    start = State((east_m, north_m, up_m + 0.192), heading_rad=0.0)
    return AgentStart(name, "turtlebot3_burger", start, False, 0.192)


def iris(name: str = "iris", east_m: float = 0.0, up_m: float = 5.0) -> AgentStart:
    return AgentStart(name, "iris", State((east_m, -3.0, up_m), heading_rad=0.0), True)


def state_after(
    simulation: MujocoPhysics, seconds: float, commands: Mapping[str, Any] | None = None
) -> Mapping[str, State]:
    return simulation.advance(round(seconds * 1e9), commands or {})


def test_a_robot_above_the_ground_falls_freely() -> None:
    simulation = physics(husky(up_m=5.0))
    for steps in (1, 100, 900):
        state = simulation.advance(steps * 1_000_000, {})["husky"]
        # The sum of n steps of the semi-implicit Euler method; g t^2 / 2 is its limit.
        fall_m = GRAVITY_M_S2 * 1e-6 * steps * (steps + 1) / 2
        assert state.position_m == pytest.approx((0.0, 0.0, 5.39 - fall_m), abs=1e-9)
        assert state.velocity_m_s[2] == pytest.approx(-GRAVITY_M_S2 * steps / 1000)


def test_robots_drive_straight_at_the_commanded_speed() -> None:
    simulation = physics(husky(), burger())
    state_after(simulation, 0, {"husky": Twist(1.0), "burger": Twist(0.2)})
    earlier_states = state_after(simulation, 1)
    later_states = state_after(simulation, 4)
    for name, speed_m_s, slip in (("husky", 1.0, 0.001), ("burger", 0.2, 0.004)):
        distance_m = later_states[name].position_m[0] - earlier_states[name].position_m[0]
        assert distance_m == pytest.approx(3 * speed_m_s, rel=slip)
        assert later_states[name].position_m[1] == pytest.approx(earlier_states[name].position_m[1], abs=1e-6)


def test_turning_rates_follow_from_friction() -> None:
    """A skid-steered robot turns where the moments of friction vanish; one with two wheels rolls."""
    simulation = physics(husky(), burger())
    state_after(simulation, 0, {"husky": Twist(0.0, 1.0), "burger": Twist(0.0, 1.0)})
    earlier_states = state_after(simulation, 1.5)
    later_states = state_after(simulation, 2.5)
    base_m, track_m = HUSKY.wheels.axles_m[0], HUSKY.wheels.track_m / 2
    expected = {"husky": 1.875 * track_m**2 / (base_m**2 + track_m**2), "burger": 1.0}
    for name, rate_rad_s in expected.items():
        rotation_rad = (later_states[name].heading_rad or 0.0) - (earlier_states[name].heading_rad or 0.0)
        assert rotation_rad == pytest.approx(rate_rad_s, rel=0.005)
        assert later_states[name].position_m == pytest.approx(earlier_states[name].position_m, abs=2e-3)


def test_the_speed_changes_at_the_limit_of_the_drive_or_of_friction() -> None:
    slippery = vars(HUSKY_A200) | {"friction": 0.1}
    simulation = physics(husky(), husky("slippery", north_m=4.0), bodies={"slippery": slippery})
    state_after(simulation, 0, dict.fromkeys(("husky", "slippery"), Twist(1.0)))
    first, second = state_after(simulation, 0.15), state_after(simulation, 0.25)
    expected_m_s2 = {"husky": HUSKY_A200.acceleration_m_s2, "slippery": 0.1 * GRAVITY_M_S2}
    for name, limit_m_s2 in expected_m_s2.items():
        speed_change_m_s = second[name].velocity_m_s[0] - first[name].velocity_m_s[0]
        assert speed_change_m_s / 0.1 == pytest.approx(limit_m_s2, rel=0.05)


def test_a_robot_stands_on_a_slope_up_to_its_coefficient_of_friction() -> None:
    grade, height_m = math.tan(math.radians(20)), 10 * math.tan(math.radians(20))
    slippery = vars(HUSKY_A200) | {"friction": 0.2}
    agents = husky(up_m=height_m), husky("slippery", north_m=5.0, up_m=height_m)
    simulation = physics(*agents, obstacles=(ramp(20, 20),), bodies={"slippery": slippery})
    first, second = state_after(simulation, 1), state_after(simulation, 2)
    assert math.dist(first["husky"].position_m, second["husky"].position_m) < 1e-4
    normal_m_s2 = GRAVITY_M_S2 / math.hypot(1, grade)
    sliding_speed_change_m_s = math.dist(first["slippery"].velocity_m_s, second["slippery"].velocity_m_s)
    assert sliding_speed_change_m_s == pytest.approx((grade - 0.2) * normal_m_s2, rel=0.02)


def test_robots_stop_at_a_wall_and_do_not_pass_it() -> None:
    simulation = physics(husky(), burger(east_m=2.5), iris(up_m=1.0), obstacles=(WALL,))
    commands = {"husky": Twist(1.0), "burger": Twist(0.2), "iris": Velocity((3.0, 0.0, 0.0))}
    state_after(simulation, 0, commands)
    # The drone tips over at the wall, so its centre comes nearer to the wall than its radius.
    reach_m = {"husky": 0.9874 / 2, "burger": 0.07 - 0.032, "iris": 0.1}
    for tenth in range(1, 50):
        states = state_after(simulation, tenth / 10)
        for name, length_m in reach_m.items():
            assert states[name].position_m[0] < WALL_EAST_M - length_m + 0.05
    for name in ("husky", "burger"):
        assert states[name].position_m[0] == pytest.approx(WALL_EAST_M - reach_m[name], abs=0.01)
        assert math.hypot(*states[name].velocity_m_s) < 0.01


def test_a_robot_climbs_a_ramp_to_raised_ground_but_not_its_side() -> None:
    raised_ground: dict[str, object] = {
        "name": "raised",
        "kind": "raised",
        "centre_m": [7, 0],
        "size_m": [4, 20, 4 * math.tan(0.15)],
    }
    obstacles = (ramp(math.degrees(0.15), 4, 3.0), raised_ground)
    simulation = physics(husky(), burger("blocked", east_m=10.0), obstacles=obstacles)
    state_after(simulation, 0, {"husky": Twist(1.0), "blocked": Twist(-0.2)})
    states = state_after(simulation, 7.5)
    east_m, north_m, up_m = states["husky"].position_m
    assert east_m == pytest.approx(7.3, abs=0.1)
    assert (north_m, up_m) == pytest.approx((0.0, 4 * math.tan(0.15) + 0.39), abs=0.01)
    assert 9.1 <= states["blocked"].position_m[0] < 9.15
    assert states["blocked"].position_m[2] == pytest.approx(0.192, abs=0.01)


def test_a_quadrotor_reaches_the_commanded_velocity_and_keeps_its_height() -> None:
    simulation = physics(iris())
    state_after(simulation, 0, {"iris": Velocity((3.0, 1.0, 0.0), 1.0)})
    lowest_m = min(state_after(simulation, tenth / 10)["iris"].position_m[2] for tenth in range(60))
    state = state_after(simulation, 6)["iris"]
    assert state.velocity_m_s == pytest.approx((3.0, 1.0, 0.0), abs=0.01)
    assert state.heading_rad == pytest.approx(1.0, abs=1e-3)
    assert lowest_m == pytest.approx(5.0, abs=0.1)
    state_after(simulation, 6, {"iris": Velocity((0.0, 0.0, -9.0))})
    assert state_after(simulation, 8)["iris"].velocity_m_s[2] == pytest.approx(-1.5, abs=0.01)


def test_a_quadrotor_turns_on_the_ground_and_takes_off() -> None:
    simulation = physics(iris(up_m=0.0))
    state_after(simulation, 0, {"iris": Velocity(yaw_rad=3.0)})
    assert state_after(simulation, 3)["iris"].position_m[2] == pytest.approx(0.0, abs=1e-3)
    state_after(simulation, 3, {"iris": Velocity((0.0, 0.0, 1.0))})
    assert state_after(simulation, 5)["iris"].position_m[2] == pytest.approx(1.75, abs=0.05)


def test_robots_at_rest_do_not_drift() -> None:
    simulation = physics(husky(), burger(), iris())
    settled_states = state_after(simulation, 1)
    states = state_after(simulation, 6)
    for name, state in states.items():
        assert math.dist(state.position_m, settled_states[name].position_m) < 1e-6
        assert math.hypot(*state.velocity_m_s) < 1e-6
