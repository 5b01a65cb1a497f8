"""The airframe of the drone, compared with closed forms and its limits, among the obstacles of its world."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.flight import STEP_NS, Airframe, stop_m, velocity_to
from sim_backends.physics.collisions import Footprint
from sim_backends.physics.ground import Ground
from sim_backends.physics.robot_limits import DUCKIEDRONE, IRIS, QuadrotorLimits
from sim_backends.world.motion import GRAVITY_M_S2
from sim_backends.world.world import World

STEP_S = STEP_NS / 1e9
FLOOR = Ground(None, None).obstacles
OVERSHOOT = 1e-2
"""Fraction by which a speed may exceed its limit for a short time, because the attitude lags."""

coordinates = st.floats(-80, 80)
points = st.tuples(coordinates, coordinates, st.floats(-9, 40))
velocities = st.tuples(coordinates, coordinates, coordinates)
quadrotors = st.sampled_from([DUCKIEDRONE, IRIS])


def hovering_drone(limits: QuadrotorLimits = DUCKIEDRONE, heading_rad: float = 0.0) -> Airframe:
    """Return a drone that hovers 10 m above the ground, where its home is."""
    body = Airframe(limits, (3.0, 4.0, 10.0), heading_rad, FLOOR, 0)
    body.motors_on = True
    body.step((0.0, 0.0, 0.0), limits)
    return body


@settings(max_examples=12)
@given(quadrotors, st.lists(st.tuples(velocities, st.integers(1, 100)), min_size=1, max_size=4))
def test_commands_do_not_exceed_the_limits(limits: QuadrotorLimits, commands: list[tuple[Vector, int]]) -> None:
    body = hovering_drone(limits)
    for velocity_m_s, steps in commands:
        for _ in range(steps):
            body.step(velocity_m_s, limits)
            east, north, up = body.velocity_m_s
            assert math.hypot(east, north) <= limits.speed_m_s * (1 + OVERSHOOT)
            assert -limits.climb_m_s[0] * (1 + OVERSHOOT) <= up <= limits.climb_m_s[1] * (1 + OVERSHOOT)
            assert body.place_m[2] >= 0
            assert max(map(abs, body.tilt_rad)) <= limits.tilt_rad + 1e-9


@settings(max_examples=12)
@given(quadrotors, points)
def test_the_drone_reaches_a_point_with_little_overshoot(limits: QuadrotorLimits, goal: Vector) -> None:
    body = hovering_drone(limits)
    direct_m = math.hypot(*goal[:2])
    for _ in range(30_000):
        body.step(velocity_to(goal, body, limits), limits)
        if direct_m > 1:
            along_m = (body.position_m[0] * goal[0] + body.position_m[1] * goal[1]) / direct_m
            assert along_m < direct_m + 0.1 * min(direct_m, 10.0)
        if math.dist(goal, body.position_m) < 0.01 and math.hypot(*body.velocity_m_s) < 0.01:
            return
    raise AssertionError(body.position_m)


@settings(max_examples=12)
@given(quadrotors, velocities)
def test_the_drone_stops_at_the_predicted_position(limits: QuadrotorLimits, velocity_m_s: Vector) -> None:
    body = hovering_drone(limits)
    for _ in range(500):
        body.step((velocity_m_s[0], velocity_m_s[1], 0.0), limits)
    predicted_m = stop_m(body, limits)
    while math.hypot(*body.velocity_m_s) > 1e-3:
        body.step((0.0, 0.0, 0.0), limits)
    distance_m, predicted_distance_m = math.hypot(*body.position_m[:2]), math.hypot(*predicted_m[:2])
    assert distance_m <= predicted_distance_m + 0.1


def test_a_drone_without_motors_falls_with_drag_and_comes_to_rest() -> None:
    """Linear drag alone, from rest: v(t) = g m / c (1 - exp(-c t / m))."""
    limits = replace(DUCKIEDRONE, drag_n_s2_m2=0.0)
    body = hovering_drone(limits)
    body.motors_on = False
    climb_rates_m_s = []
    while not body.on_ground:
        body.step((0.0, 0.0, 5.0), limits)
        climb_rates_m_s.append(body.velocity_m_s[2])
    tau_s = limits.mass_kg / limits.drag_n_s_m
    assert climb_rates_m_s[99] == pytest.approx(
        -GRAVITY_M_S2 * tau_s * (1 - math.exp(-100 * STEP_S / tau_s)), rel=0.01
    )
    assert body.velocity_m_s == (0.0, 0.0, 0.0)
    assert body.tilt_rad == (0.0, 0.0)
    assert body.place_m[2] == pytest.approx(0.0, abs=1e-6)


def test_the_drone_tilts_towards_its_acceleration() -> None:
    """With its nose to the north, it accelerates to the east by rolling right, and to the north by pitching down."""
    body = hovering_drone(heading_rad=math.pi / 2)
    for _ in range(20):
        body.step((0.2, 0.0, 0.0), DUCKIEDRONE)
    assert body.tilt_rad[0] > 0.01
    for _ in range(20):
        body.step((0.0, 2.0, 0.0), DUCKIEDRONE)
    assert body.tilt_rad[1] < -0.05


def house() -> Sequence[Footprint]:
    """Return a house with a height of 3 m, from 4 m to 8 m east."""
    box = {"name": "house", "kind": "box", "material": "concrete", "centre_m": [6, 0], "size_m": [4, 4, 3]}
    world = World.model_validate({"name": "w", "summary": "", "area_m": [40, 40], "obstacles": [box]})
    return Ground(world, None).obstacles


def test_the_drone_lands_on_the_roof_below_it_and_a_wall_stops_it() -> None:
    body = Airframe(DUCKIEDRONE, (0.0, 0.0, 0.0), 0.0, house(), 0)
    body.motors_on = True
    for _ in range(2_000):
        body.step(velocity_to((6.0, 0.0, 1.5), body, DUCKIEDRONE), DUCKIEDRONE)
    assert body.place_m[0] == pytest.approx(4.0 - DUCKIEDRONE.radius_m, abs=1e-3), "the wall"
    for goal in ((-2.0, 0.0, 6.0), (6.0, 0.0, 6.0)):
        for _ in range(3_000):
            body.step(velocity_to(goal, body, DUCKIEDRONE), DUCKIEDRONE)
    assert not body.on_ground
    for _ in range(2_000):
        body.step((0.0, 0.0, -0.5), DUCKIEDRONE)
    assert body.on_ground
    assert body.place_m[2] == pytest.approx(3.0, abs=1e-6)
