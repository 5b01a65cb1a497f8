"""Contacts of bodies with obstacles and with each other, compared with results computed by hand."""

import math
from itertools import combinations
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.quadrotor import Quadrotor
from sim_backends.physics.robot_limits import HUSKY_A200, IRIS, DriveLimits
from tests.helpers.worlds import world

MS = 1_000_000
R_M = HUSKY_A200.radius_m
ROVER = DriveLimits(1.0, 3.0, 2.0, 6.0, radius_m=0.3, height_m=0.4)


def wall(from_m: tuple[float, float], to_m: tuple[float, float], thickness: str = "0.1m") -> dict[str, Any]:
    return {"name": "wall", "kind": "wall", "from_m": from_m, "to_m": to_m, "thickness": thickness}


def husky(place_m: tuple[float, float], heading_deg: float = 0.0) -> DifferentialDrive:
    return DifferentialDrive(HUSKY_A200, place_m, math.radians(heading_deg), antenna_m=0.0)


def test_a_robot_that_heads_straight_into_a_wall_stops() -> None:
    bodies = Bodies({"a": husky((0.0, 0.0))}, world(wall((3, -5), (3, 5))))
    bodies.advance(0, {})
    state = bodies.advance(5000 * MS, {"a": Twist(1.0)})["a"]
    assert state.position_m == pytest.approx((2.95 - R_M, 0.0, 0.0), abs=1e-9)
    assert state.velocity_m_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    # The robot reaches 1 m/s after 1/6 m and a third of a second. There is one contact, however long it pushes.
    contact_s = 1 / 3 + 2.95 - R_M - 1 / 6
    assert [(collision.body, collision.obstacle) for collision in bodies.collisions] == [("a", "wall")]
    assert bodies.collisions[0].at_ns == pytest.approx(contact_s * 1e9, abs=MS)
    # It accelerates away from the wall as its drive allows.
    bodies.advance(5000 * MS, {"a": Twist(-1.0)})
    assert bodies.advance(5100 * MS, {})["a"].velocity_m_s[0] == pytest.approx(-0.3)


def test_a_robot_slides_along_a_wall() -> None:
    bodies = Bodies({"a": husky((2.0, 0.0), 60)}, world(wall((3, -50), (3, 50))))
    bodies.advance(0, {"a": Twist(1.0)})
    earlier_state = bodies.advance(5000 * MS, {"a": Twist(1.0)})["a"]
    later_state = bodies.advance(6000 * MS, {})["a"]
    assert earlier_state.position_m[0] == later_state.position_m[0] == pytest.approx(2.95 - R_M, abs=1e-9)
    # The speed is multiplied by sin 60 degrees twice: by the heading, and by the contact, which is along the wall.
    expected_m_s = math.sin(math.radians(60)) ** 2
    assert earlier_state.velocity_m_s == pytest.approx((0.0, expected_m_s, 0.0), abs=1e-9)
    assert later_state.position_m[1] - earlier_state.position_m[1] == pytest.approx(expected_m_s, rel=0.01)


def test_a_robot_slides_around_a_trunk_and_passes_below_a_crown() -> None:
    oak = {"name": "oak", "kind": "tree", "at_m": (3, 0.2), "trunk_radius": "0.3m"}
    bodies = Bodies({"a": husky((0.0, 0.0))}, world(oak))
    bodies.advance(0, {"a": Twist(1.0)})
    state = bodies.advance(20_000 * MS, {"a": Twist(1.0)})["a"]
    assert state.position_m[0] > 10
    # The robot leaves the trunk when the trunk is beside it.
    assert state.position_m[1] == pytest.approx(0.2 - 0.3 - R_M, abs=1e-6)
    assert [collision.obstacle for collision in bodies.collisions] == ["oak"]


def test_a_robot_neither_climbs_raised_ground_nor_drives_off_it() -> None:
    knolls = [
        {"name": f"knoll-{number}", "kind": "raised", "centre_m": (4 * number, 0), "size_m": (4, 3, 0.5)}
        for number in (1, 2)
    ]
    bodies = Bodies({"below": husky((0.0, 0.0)), "above": husky((4.0, 0.5), 20)}, world(*knolls))
    bodies.advance(0, {})
    states = bodies.advance(15_000 * MS, dict.fromkeys(("below", "above"), Twist(1.0)))
    assert states["below"].position_m == pytest.approx((2 - R_M, 0.0, 0.0), abs=1e-9)
    # It drives across both areas, which form one plateau, and along the edge at 1.5 m north into the corner.
    assert states["above"].position_m == pytest.approx((10.0, 1.5, 0.5), abs=1e-9)
    assert states["above"].velocity_m_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_a_fast_robot_does_not_pass_through_a_thin_wall() -> None:
    rocket = DriveLimits(300.0, 1e9, 1.0, 1.0, radius_m=0.3, height_m=0.4, friction=1e12)
    thin_wall = wall((7, -5), (7, 5), thickness="0.001m")
    bodies = Bodies({"a": DifferentialDrive(rocket, (0.0, 0.0))}, world(thin_wall), step_ns=20 * MS)
    bodies.advance(0, {})
    assert bodies.advance(1000 * MS, {"a": Twist(300.0)})["a"].position_m[0] == pytest.approx(
        7 - 0.0005 - 0.3, abs=0.1
    )


def test_bodies_stop_at_each_other_without_pushing() -> None:
    bodies = Bodies({"a": husky((0.0, 0.0)), "b": husky((4.0, 0.0), 180), "c": husky((0.0, 5.0))})
    bodies.advance(0, {"a": Twist(1.0), "b": Twist(0.5)})
    states = bodies.advance(10_000 * MS, {"a": Twist(1.0), "b": Twist(0.5)})
    a_m, b_m = states["a"].position_m[0], states["b"].position_m[0]
    assert b_m - a_m == pytest.approx(2 * R_M, abs=1e-6)
    # They meet at speeds of 1 and 0.5 m/s, after accelerating at 3 m/s^2 each.
    contact_s = (4 - 2 * R_M + 1 / 6 + 1 / 24) / 1.5
    assert a_m == pytest.approx(contact_s - 1 / 6, abs=2e-3)
    assert {(collision.body, collision.obstacle) for collision in bodies.collisions} == {("a", "b"), ("b", "a")}
    bodies_at_rest = Bodies({"a": husky((0.0, 0.0)), "b": husky((4.0, 0.0))})
    bodies_at_rest.advance(0, {})
    states = bodies_at_rest.advance(10_000 * MS, {"a": Twist(1.0)})
    assert states["b"].position_m == (4.0, 0.0, 0.0)
    assert states["a"].position_m[0] == pytest.approx(4 - 2 * R_M, abs=1e-9)


TWISTS = st.builds(Twist, st.floats(-1, 1), st.floats(-2, 2))


@settings(max_examples=25)
@given(st.lists(st.tuples(st.integers(1, 900), st.lists(TWISTS, min_size=4, max_size=4)), min_size=1, max_size=5))
def test_bodies_do_not_overlap_and_extrapolation_errors_are_within_the_limits(
    legs: list[tuple[int, list[Twist]]],
) -> None:
    names = "abcd"
    yard = world(wall((1.5, -9), (1.5, 9)), wall((-9, 2), (9, 2.2)), wall((-2.5, -9), (-2, 9)))
    bodies = Bodies(
        {name: husky((0.0, -3.0 + 1.25 * number), 90 * number) for number, name in enumerate(names)}, yard
    )
    at_ms = 0
    states_by_ms = {0: (bodies.advance(0, {}), dict(bodies.limits_m_s2))}
    for ms, twists in legs:
        commands = dict(zip(names, twists, strict=True))
        for offset_ms in range(0, ms, 37):
            states = bodies.advance((at_ms + offset_ms) * MS, commands if not offset_ms else {})
            states_by_ms[at_ms + offset_ms] = states, dict(bodies.limits_m_s2)
            for first, second in combinations(names, 2):
                distance_m = math.dist(states[first].position_m, states[second].position_m)
                assert distance_m >= 2 * R_M - 1e-6
            for name in names:
                assert states[name].position_m[0] <= 1.45 - R_M + 1e-6
        at_ms += ms
        bodies.advance(at_ms * MS, {})
    for begin_ms, (begin_states, limits) in states_by_ms.items():
        for end_ms, (end_states, _) in states_by_ms.items():
            t = (end_ms - begin_ms) / 1000
            for name in names if t > 0.001 else ():
                initial = begin_states[name]
                extrapolated_m = [
                    metres + v * t for metres, v in zip(initial.position_m, initial.velocity_m_s, strict=True)
                ]
                assert math.dist(end_states[name].position_m, extrapolated_m) <= limits[name] * t * t / 2 + 1e-6


def test_a_robot_that_drives_up_a_ramp_stops_below_an_obstacle_above_it() -> None:
    hill = {"name": "up", "kind": "ramp", "centre_m": (5, 0), "size_m": (10, 4, 2)}
    hovering_drone = Quadrotor(IRIS, (5.0, 0.0, 1.0 + 0.3))
    bodies = Bodies({"a": DifferentialDrive(ROVER, (1.0, 0.0), antenna_m=0.0), "b": hovering_drone}, world(hill))
    bodies.advance(0, {})
    state = bodies.advance(10_000 * MS, {"a": Twist(1.0)})["a"]
    assert state.position_m[2] == pytest.approx(0.2 * state.position_m[0], abs=1e-9)
    # Its roof, 0.4 m above ground that rises by a fifth, touches the quadrotor at 1.3 m.
    assert state.position_m[0] == pytest.approx(0.9 / 0.2, abs=2e-3)
    assert {(collision.body, collision.obstacle) for collision in bodies.collisions} == {("a", "b")}
