"""The point mass, against closed forms and its own limits."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.autopilot.flight import GRAVITY_M_S2, STEP_NS, Envelope, PointMass, velocity_to, within

CAN = Envelope(speed_m_s=3.0, climb_m_s=2.0, descent_m_s=1.0, acceleration_m_s2=3.0, climb_acceleration_m_s2=4.0)
STEP_S = STEP_NS / 1e9

coordinates = st.floats(-100, 100)
points = st.tuples(coordinates, coordinates, st.floats(0, 50))
wishes = st.tuples(coordinates, coordinates, coordinates)


def flying(up_m: float = 10.0) -> PointMass:
    return PointMass(0, position_m=(0.0, 0.0, up_m), driven=True)


@given(st.lists(st.tuples(wishes, st.integers(1, 100)), min_size=1, max_size=5))
def test_no_wish_takes_it_beyond_its_limits(led: list[tuple[tuple[float, float, float], int]]) -> None:
    body = flying()
    for wish, steps in led:
        for _ in range(steps):
            before = body.velocity_m_s
            body.step(wish, CAN)
            east, north, up = body.velocity_m_s
            assert math.hypot(east, north) <= CAN.speed_m_s + 1e-9
            assert -CAN.descent_m_s - 1e-9 <= up <= CAN.climb_m_s + 1e-9
            assert math.dist((east, north), before[:2]) <= CAN.acceleration_m_s2 * STEP_S + 1e-9
            assert body.position_m[2] >= 0
            assert body.on_ground or abs(up - before[2]) <= CAN.climb_acceleration_m_s2 * STEP_S + 1e-9


@given(points)
def test_it_comes_to_a_point_and_never_beyond(goal: tuple[float, float, float]) -> None:
    body = flying()
    direct_m = math.hypot(*goal[:2])
    for _ in range(12_000):
        body.step(velocity_to(goal, body, CAN), CAN)
        if direct_m > 1:
            along_m = (body.position_m[0] * goal[0] + body.position_m[1] * goal[1]) / direct_m
            assert along_m < direct_m + 0.02
        if math.dist(goal, body.position_m) < 0.01:
            return
    raise AssertionError(body)


def test_full_speed_is_reached_as_constant_acceleration_reaches_it() -> None:
    body = flying()
    steps = 0
    while body.velocity_m_s[0] < CAN.speed_m_s - 1e-9:
        body.step((100.0, 0.0, 0.0), CAN)
        steps += 1
    assert steps * STEP_S == pytest.approx(CAN.speed_m_s / CAN.acceleration_m_s2)
    assert body.position_m[0] == pytest.approx(CAN.speed_m_s**2 / 2 / CAN.acceleration_m_s2)


def test_without_motors_it_falls_as_a_stone_and_lies_still() -> None:
    body = PointMass(0, position_m=(0.0, 0.0, 20.0), velocity_m_s=(1.0, 0.0, 0.0))
    steps = 0
    while not body.on_ground:
        body.step((0.0, 0.0, 5.0), CAN)
        steps += 1
    fall_s = math.sqrt(2 * 20.0 / GRAVITY_M_S2)
    assert steps * STEP_S == pytest.approx(fall_s, abs=2 * STEP_S)
    assert body.position_m[0] == pytest.approx(fall_s, abs=2 * STEP_S)
    assert body.velocity_m_s == (0.0, 0.0, 0.0)


def test_it_leans_into_its_acceleration() -> None:
    """Speeding up eastwards with the nose north is a roll to the right, of which the tangent is a / g."""
    body = flying()
    body.step((3.0, 0.0, 0.0), CAN)
    roll_rad, pitch_rad = body.tilt_rad
    assert math.tan(roll_rad) == pytest.approx(CAN.acceleration_m_s2 / GRAVITY_M_S2)
    assert pitch_rad == pytest.approx(0.0, abs=1e-9)


def test_nose_down_to_go_ahead() -> None:
    body = flying()
    body.step((0.0, 3.0, 0.0), CAN)
    assert body.tilt_rad[1] < -0.2


@given(wishes)
def test_a_wish_keeps_its_direction_over_the_ground(wish: tuple[float, float, float]) -> None:
    east, north, _ = within(wish, CAN)
    assert east * wish[1] - north * wish[0] == pytest.approx(0.0, abs=1e-6)
