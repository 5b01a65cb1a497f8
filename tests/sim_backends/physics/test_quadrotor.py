"""A quadrotor, compared with results computed by hand."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.quadrotor import FlightPose, Quadrotor, VelocityController
from sim_backends.physics.robot_limits import DUCKIEDRONE, IRIS, QuadrotorLimits
from sim_backends.world.motion import GRAVITY_M_S2
from tests.helpers.worlds import world

S = 1_000_000_000


def fly(
    limits: QuadrotorLimits, seconds: float, velocity: Velocity | None, place_m: Vector = (0.0, 0.0, 100.0)
) -> Mapping[str, Any]:
    bodies = Bodies({"a": Quadrotor(limits, place_m)})
    bodies.advance(0, {"a": velocity} if velocity else {})
    bodies.advance(0, {"a": velocity} if velocity else {})
    state = bodies.advance(round(seconds * S), {})["a"]
    pose = bodies._tracks["a"].pose(bodies._step)
    return {"state": state, "pose": pose, "bodies": bodies}


def test_hovering_thrust_equals_the_weight() -> None:
    assert VelocityController(IRIS).thrust_m_s2((0.0, 0.0, 0.0), Velocity()) == (0.0, 0.0, GRAVITY_M_S2)
    assert fly(IRIS, 60.0, None)["state"].position_m == (0.0, 0.0, 100.0)


@pytest.mark.parametrize(("limits", "speed_m_s"), [(IRIS, 8.0), (IRIS, 3.0), (DUCKIEDRONE, 2.0)])
def test_the_tilt_balances_the_drag(limits: QuadrotorLimits, speed_m_s: float) -> None:
    result = fly(limits, 30.0, Velocity((0.0, speed_m_s, 0.0), yaw_rad=math.pi / 2))
    drag_n = limits.drag_n_s_m * speed_m_s + limits.drag_n_s2_m2 * speed_m_s**2
    assert result["state"].velocity_m_s == pytest.approx((0.0, speed_m_s, 0.0), abs=1e-7)
    assert math.tan(result["pose"].pitch_rad) == pytest.approx(drag_n / (limits.mass_kg * GRAVITY_M_S2), abs=1e-7)
    assert result["pose"].roll_rad == pytest.approx(0.0, abs=1e-7)
    assert result["state"].tilt_rad == (result["pose"].roll_rad, result["pose"].pitch_rad)
    assert result["state"].heading_rad == pytest.approx(math.pi / 2)
    assert result["state"].position_m[2] == pytest.approx(100.0, abs=0.05)


def test_a_quadrotor_without_thrust_reaches_its_terminal_velocity() -> None:
    without_thrust = replace(IRIS, thrust_n=(0.0, 0.0))
    result = fly(without_thrust, 60.0, None, (0.0, 0.0, 5000.0))
    weight_n = IRIS.mass_kg * GRAVITY_M_S2
    a, b = IRIS.drag_n_s2_m2, IRIS.drag_n_s_m
    terminal_m_s = (-b + math.sqrt(b * b + 4 * a * weight_n)) / (2 * a)
    assert result["state"].velocity_m_s == pytest.approx((0.0, 0.0, -terminal_m_s), rel=1e-6)
    # With quadratic drag only, v = V tanh(g t / V), and the height lost is V^2 / g ln(cosh(g t / V)).
    quadratic_drag = replace(without_thrust, drag_n_s_m=0.0)
    falling_state = fly(quadratic_drag, 2.0, None, (0.0, 0.0, 5000.0))["state"]
    v_m_s = math.sqrt(weight_n / a)
    path_m = v_m_s**2 / GRAVITY_M_S2 * math.log(math.cosh(GRAVITY_M_S2 * 2 / v_m_s))
    assert 5000 - falling_state.position_m[2] == pytest.approx(path_m, rel=1e-3)


def test_the_velocity_error_decays_with_the_gain() -> None:
    """Vertical thrust has no lag: below the acceleration limit the velocity error decays by exp(-gain t)."""
    result = fly(IRIS, 0.5, Velocity((0.0, 0.0, 0.9)))["state"]
    assert result.velocity_m_s[2] == pytest.approx(0.9 * (1 - math.exp(-4.0 * 0.5)), rel=2e-3)


def test_a_quadrotor_turns_to_its_target_yaw_in_the_shorter_direction() -> None:
    # The shorter turn from 3 rad is by 0.78 rad, across pi. In 0.1 s it turns by 9 degrees, at 90 degrees per second.
    bodies = Bodies({"a": Quadrotor(DUCKIEDRONE, (0.0, 0.0, 1.0), 3.0)})
    bodies.advance(0, {"a": Velocity(yaw_rad=-2.5)})
    assert bodies.advance(S // 10, {"a": Velocity(yaw_rad=-2.5)})["a"].heading_rad == pytest.approx(
        3.0 + math.radians(9), abs=1e-9
    )


def test_quadrotors_land_on_the_ground_and_on_roofs_and_stop_below_ceilings() -> None:
    building = {"name": "house", "kind": "building", "centre_m": (10, 0), "size_m": (6, 6, 3)}
    bodies = Bodies(
        {
            "ground": Quadrotor(IRIS, (0.0, 0.0, 2.0)),
            "roof": Quadrotor(IRIS, (10.0, 0.0, 5.0)),
            "inside": Quadrotor(IRIS, (10.0, 0.0, 1.0)),
        },
        world(building),
    )
    bodies.advance(0, {})
    down, up = Velocity((0.0, 0.0, -1.0)), Velocity((0.0, 0.0, 1.0))
    states = bodies.advance(8 * S, {"ground": down, "roof": down, "inside": up})
    heights = {name: state.position_m[2] for name, state in states.items()}
    assert heights == pytest.approx({"ground": 0.0, "roof": 3.0, "inside": 2.8 - IRIS.height_m}, abs=1e-9)
    assert {(collision.body, collision.obstacle) for collision in bodies.collisions} == {
        ("ground", "ground"), ("roof", "house"), ("inside", "house"),
    }  # fmt: skip


@pytest.mark.parametrize("command", [Twist(), Velocity((math.nan, 0.0, 0.0)), Velocity(yaw_rad=math.inf)])
def test_an_unsuitable_command_is_rejected(command: object) -> None:
    bodies = Bodies({"a": Quadrotor(IRIS, (0.0, 0.0, 1.0))})
    with pytest.raises(ConfigurationError, match="a quadrotor cannot follow"):
        bodies.advance(S, {"a": command})


SPEEDS = st.floats(-30, 30)
VELOCITIES = st.builds(Velocity, st.tuples(SPEEDS, SPEEDS, SPEEDS), st.none() | st.floats(-4, 4))


@settings(max_examples=40)
@given(
    st.sampled_from([IRIS, DUCKIEDRONE]),
    st.lists(st.tuples(st.floats(0.001, 0.8), VELOCITIES), min_size=1, max_size=5),
    st.sampled_from([1, 20]),
)
def test_extrapolation_errors_are_within_the_limit(
    limits: QuadrotorLimits, legs: list[tuple[float, Velocity]], step_ms: int
) -> None:
    bodies = Bodies({"a": Quadrotor(limits, (0.0, 0.0, 1000.0))}, step_ns=step_ms * 1_000_000)
    samples = [(0.0, bodies.advance(0, {})["a"], bodies.limits_m_s2["a"])]
    at_ns = 0
    for seconds, velocity in legs:
        for part in (0.2, 0.8):
            at_ns += round(part * seconds * S)
            state = bodies.advance(at_ns, {"a": velocity})["a"]
            samples.append((at_ns // bodies.step_ns * bodies.step_ns / S, state, bodies.limits_m_s2["a"]))
    top_speed_m_s = limits.top_speed_m_s()
    for number, (start_s, start, limit) in enumerate(samples):
        assert math.hypot(*start.velocity_m_s) <= top_speed_m_s
        for end_s, end, _ in samples[number:]:
            t = end_s - start_s
            assert math.dist(end.velocity_m_s, start.velocity_m_s) <= limit * t + 1e-9
            extrapolated_m = [metres + v * t for metres, v in zip(start.position_m, start.velocity_m_s, strict=True)]
            assert math.dist(end.position_m, extrapolated_m) <= limit * t * t / 2 + 1e-9


def test_roll_and_pitch_do_not_exceed_their_limits() -> None:
    controller = VelocityController(IRIS)
    pose = FlightPose((0.0, 0.0, 50.0))
    for number in range(3000):
        target = Velocity((12.0, 0.0, 3.0) if number // 300 % 2 else (-12.0, 12.0, -3.0))
        next_pose = controller.fly(pose, target, 0.001)
        for value, previous in ((next_pose.roll_rad, pose.roll_rad), (next_pose.pitch_rad, pose.pitch_rad)):
            assert abs(value - previous) <= IRIS.tilt_rate_rad_s * 0.001 + 1e-12
            assert abs(value) <= IRIS.tilt_rad
        pose = next_pose
