"""A quadrotor against what can be worked out on paper."""

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
from sim_backends.physics.body import GRAVITY_M_S2, Twist, Velocity
from sim_backends.physics.quadrotor import (
    DUCKIEDRONE,
    IRIS,
    FlightPose,
    Quadrotor,
    QuadrotorLimits,
    VelocityController,
)
from tests.helpers.worlds import world

S = 1_000_000_000


def flown(
    limits: QuadrotorLimits, seconds: float, velocity: Velocity | None, place_m: Vector = (0.0, 0.0, 100.0)
) -> Mapping[str, Any]:
    bodies = Bodies({"a": Quadrotor(limits, place_m)})
    bodies.advance(0, {"a": velocity} if velocity else {})
    bodies.advance(0, {"a": velocity} if velocity else {})
    state = bodies.advance(round(seconds * S), {})["a"]
    pose = bodies._tracks["a"].pose(bodies._step)
    return {"state": state, "pose": pose, "bodies": bodies}


def test_it_hovers_at_its_weight() -> None:
    assert VelocityController(IRIS).thrust_m_s2((0.0, 0.0, 0.0), Velocity()) == (0.0, 0.0, GRAVITY_M_S2)
    assert flown(IRIS, 60.0, None)["state"].position_m == (0.0, 0.0, 100.0)


@pytest.mark.parametrize(("limits", "speed_m_s"), [(IRIS, 8.0), (IRIS, 3.0), (DUCKIEDRONE, 2.0)])
def test_it_leans_as_far_as_drag_takes(limits: QuadrotorLimits, speed_m_s: float) -> None:
    after = flown(limits, 30.0, Velocity((0.0, speed_m_s, 0.0), yaw_rad=math.pi / 2))
    drag_n = limits.drag_n_s_m * speed_m_s + limits.drag_n_s2_m2 * speed_m_s**2
    assert after["state"].velocity_m_s == pytest.approx((0.0, speed_m_s, 0.0), abs=1e-7)
    assert math.tan(after["pose"].pitch_rad) == pytest.approx(drag_n / (limits.mass_kg * GRAVITY_M_S2), abs=1e-7)
    assert after["pose"].roll_rad == pytest.approx(0.0, abs=1e-7)
    assert after["state"].heading_rad == pytest.approx(math.pi / 2)
    assert after["state"].position_m[2] == pytest.approx(100.0, abs=0.05)


def test_without_thrust_it_falls_to_its_terminal_velocity() -> None:
    dead = replace(IRIS, thrust_n=(0.0, 0.0))
    after = flown(dead, 60.0, None, (0.0, 0.0, 5000.0))
    weight_n = IRIS.mass_kg * GRAVITY_M_S2
    a, b = IRIS.drag_n_s2_m2, IRIS.drag_n_s_m
    terminal_m_s = (-b + math.sqrt(b * b + 4 * a * weight_n)) / (2 * a)
    assert after["state"].velocity_m_s == pytest.approx((0.0, 0.0, -terminal_m_s), rel=1e-6)
    # With quadratic drag alone v = V tanh(g t / V), and it has fallen V^2 / g ln(cosh(g t / V)).
    pure = replace(dead, drag_n_s_m=0.0)
    fallen = flown(pure, 2.0, None, (0.0, 0.0, 5000.0))["state"]
    v_m_s = math.sqrt(weight_n / a)
    way_m = v_m_s**2 / GRAVITY_M_S2 * math.log(math.cosh(GRAVITY_M_S2 * 2 / v_m_s))
    assert 5000 - fallen.position_m[2] == pytest.approx(way_m, rel=1e-3)


def test_what_it_lacks_is_made_up_at_its_gain() -> None:
    """Upwards thrust has no lag: below the limit of acceleration, what is missing shrinks by exp(-gain t)."""
    after = flown(IRIS, 0.5, Velocity((0.0, 0.0, 0.9)))["state"]
    assert after.velocity_m_s[2] == pytest.approx(0.9 * (1 - math.exp(-4.0 * 0.5)), rel=2e-3)


def test_it_turns_towards_its_yaw_the_short_way_at_its_rate() -> None:
    # From 3 rad by 0.28 rad over the back; 0.1 s at 90 degrees a second.
    bodies = Bodies({"a": Quadrotor(DUCKIEDRONE, (0.0, 0.0, 1.0), 3.0)})
    bodies.advance(0, {"a": Velocity(yaw_rad=-2.5)})
    assert bodies.advance(S // 10, {"a": Velocity(yaw_rad=-2.5)})["a"].heading_rad == pytest.approx(
        3.0 + math.radians(9), abs=1e-9
    )


def test_it_lands_on_the_ground_and_on_roofs_and_stays_below_ceilings() -> None:
    house = {"name": "house", "kind": "building", "centre_m": (10, 0), "size_m": (6, 6, 3)}
    bodies = Bodies(
        {
            "ground": Quadrotor(IRIS, (0.0, 0.0, 2.0)),
            "roof": Quadrotor(IRIS, (10.0, 0.0, 5.0)),
            "inside": Quadrotor(IRIS, (10.0, 0.0, 1.0)),
        },
        world(house),
    )
    bodies.advance(0, {})
    down, up = Velocity((0.0, 0.0, -1.0)), Velocity((0.0, 0.0, 1.0))
    states = bodies.advance(8 * S, {"ground": down, "roof": down, "inside": up})
    heights = {name: state.position_m[2] for name, state in states.items()}
    assert heights == pytest.approx({"ground": 0.0, "roof": 3.0, "inside": 2.8 - IRIS.height_m}, abs=1e-9)
    assert {(one.body, one.obstacle) for one in bodies.collisions} == {
        ("ground", "ground"), ("roof", "house"), ("inside", "house"),
    }  # fmt: skip


@pytest.mark.parametrize("command", [Twist(), Velocity((math.nan, 0.0, 0.0)), Velocity(yaw_rad=math.inf)])
def test_a_command_that_it_cannot_do_is_refused(command: object) -> None:
    bodies = Bodies({"a": Quadrotor(IRIS, (0.0, 0.0, 1.0))})
    with pytest.raises(ConfigurationError, match="a quadrotor cannot do"):
        bodies.advance(S, {"a": command})


SPEEDS = st.floats(-30, 30)
VELOCITIES = st.builds(Velocity, st.tuples(SPEEDS, SPEEDS, SPEEDS), st.none() | st.floats(-4, 4))


@settings(max_examples=40)
@given(
    st.sampled_from([IRIS, DUCKIEDRONE]),
    st.lists(st.tuples(st.floats(0.001, 0.8), VELOCITIES), min_size=1, max_size=5),
    st.sampled_from([1, 20]),
)
def test_no_place_and_no_velocity_is_off_by_more_than_the_limit_says(
    limits: QuadrotorLimits, legs: list[tuple[float, Velocity]], step_ms: int
) -> None:
    bodies = Bodies({"a": Quadrotor(limits, (0.0, 0.0, 1000.0))}, step_ns=step_ms * 1_000_000)
    known = [(0.0, bodies.advance(0, {})["a"], bodies.limits_m_s2["a"])]
    at_ns = 0
    for seconds, velocity in legs:
        for part in (0.2, 0.8):
            at_ns += round(part * seconds * S)
            state = bodies.advance(at_ns, {"a": velocity})["a"]
            known.append((at_ns // bodies.step_ns * bodies.step_ns / S, state, bodies.limits_m_s2["a"]))
    top_m_s = limits.top_speed_m_s()
    for number, (begin_s, begin, limit) in enumerate(known):
        assert math.hypot(*begin.velocity_m_s) <= top_m_s
        for end_s, end, _ in known[number:]:
            t = end_s - begin_s
            assert math.dist(end.velocity_m_s, begin.velocity_m_s) <= limit * t + 1e-9
            there_m = [here + v * t for here, v in zip(begin.position_m, begin.velocity_m_s, strict=True)]
            assert math.dist(end.position_m, there_m) <= limit * t * t / 2 + 1e-9


def test_it_never_rolls_or_pitches_faster_or_further_than_it_can() -> None:
    pilot = VelocityController(IRIS)
    pose = FlightPose((0.0, 0.0, 50.0))
    for number in range(3000):
        wanted = Velocity((12.0, 0.0, 3.0) if number // 300 % 2 else (-12.0, 12.0, -3.0))
        then = pilot.fly(pose, wanted, 0.001)
        for one, other in ((then.roll_rad, pose.roll_rad), (then.pitch_rad, pose.pitch_rad)):
            assert abs(one - other) <= IRIS.tilt_rate_rad_s * 0.001 + 1e-12
            assert abs(one) <= IRIS.tilt_rad
        pose = then
