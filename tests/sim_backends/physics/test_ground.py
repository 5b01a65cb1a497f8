"""Slopes, compared with results computed by hand: heights, speeds, and grip of tires."""

import math

import pytest

from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.robot_limits import HUSKY_A200, DriveLimits
from sim_backends.world.motion import GRAVITY_M_S2, State
from tests.helpers.worlds import world

MS = 1_000_000
ROVER = DriveLimits(1.0, 100.0, 2.0, 6.0, radius_m=0.3, height_m=0.4, friction=0.5)
RISE = 0.2
UP = {"name": "up", "kind": "ramp", "centre_m": (10, 0), "size_m": (10, 4, 2)}
TOP = {"name": "top", "kind": "raised", "centre_m": (20, 0), "size_m": (10, 4, 2)}
HILL = world(UP, TOP)


def rover(east_m: float, north_m: float = 0.0, heading_deg: float = 0.0) -> Bodies:
    body = DifferentialDrive(ROVER, (east_m, north_m), math.radians(heading_deg), antenna_m=0.0)
    return Bodies({"a": body}, HILL)


def state_after(bodies: Bodies, ms: int, twist: Twist) -> State:
    bodies.advance(0, {})
    bodies.advance(0, {"a": twist})
    return bodies.advance(ms * MS, {})["a"]


def test_a_robot_drives_up_a_ramp_onto_the_plateau_and_down_again() -> None:
    bodies = rover(0.0)
    # It drives 5 m to the ramp, sqrt(104) m up the ramp, and the rest on the plateau. While it accelerates, it drives
    # less far than at full speed.
    acceleration_loss_m = 1 / (2 * 0.5 * GRAVITY_M_S2)
    plateau_m = 18.0 - acceleration_loss_m - 5 - math.hypot(10, 2)
    halfway = state_after(bodies, 9000, Twist(1.0))
    horizontal, vertical = 1 / math.hypot(1, RISE), RISE / math.hypot(1, RISE)
    assert halfway.velocity_m_s == pytest.approx((horizontal, 0.0, vertical), abs=1e-12)
    assert halfway.position_m == pytest.approx(
        (5 + (4 - acceleration_loss_m) * horizontal, 0.0, (4 - acceleration_loss_m) * vertical), abs=2e-3
    )
    state = bodies.advance(18_000 * MS, {})["a"]
    assert state.position_m == pytest.approx((15 + plateau_m, 0.0, 2.0), abs=4e-3)
    assert state.velocity_m_s == pytest.approx((1.0, 0.0, 0.0))
    bodies.advance(18_000 * MS, {"a": Twist(-1.0)})
    state = bodies.advance(36_000 * MS, {})["a"]
    assert state.position_m == pytest.approx((0.0, 0.0, 0.0), abs=0.5)
    assert not bodies.collisions


@pytest.mark.parametrize(
    ("heading_deg", "forward", "along", "across"),
    [(0.0, 0.9, -RISE, 0.0), (0.0, -0.9, RISE, 0.0), (180.0, 0.9, RISE, 0.0), (90.0, 0.9, 0.0, RISE)],
)
def test_the_grip_of_tires_limits_the_acceleration_on_a_slope(
    heading_deg: float, forward: float, along: float, across: float
) -> None:
    """Friction is mu m g cos(slope); gravity adds m g sin(slope) along the heading or, across it, uses grip."""
    g_cos = GRAVITY_M_S2 / math.hypot(1, RISE)
    expected_m_s2 = g_cos * (math.sqrt(0.5**2 - across**2) + along)
    state = state_after(rover(10.0, heading_deg=heading_deg), 100, Twist(forward))
    assert math.hypot(*state.velocity_m_s) == pytest.approx(0.1 * expected_m_s2, rel=1e-9)
    assert state.position_m[2] == pytest.approx(RISE * (state.position_m[0] - 5), abs=1e-12)
    roll_rad, pitch_rad = state.tilt_rad
    assert math.tan(pitch_rad) == pytest.approx(-RISE * math.cos(math.radians(heading_deg)), abs=1e-12)
    assert math.sin(roll_rad) == pytest.approx(-RISE * math.sin(math.radians(heading_deg)) / math.hypot(1, RISE))


def test_a_turning_robot_stays_on_the_slope() -> None:
    state = state_after(rover(10.0), 2000, Twist(0.5, 0.5))
    assert state.position_m[2] == pytest.approx(RISE * (state.position_m[0] - 5), abs=1e-9)
    assert math.hypot(*state.velocity_m_s) == pytest.approx(0.5)
    assert state.position_m[1] > 0.2


def test_a_slope_that_is_too_steep_is_a_wall_from_below_and_an_edge_from_above() -> None:
    steep = {**UP, "size_m": (10, 4, 6)}
    above = {**TOP, "size_m": (10, 4, 6)}
    bodies = Bodies(
        {
            "below": DifferentialDrive(ROVER, (4.0, 0.0), antenna_m=0.0),
            "above": DifferentialDrive(ROVER, (16.0, 0.0), math.pi, antenna_m=0.0),
        },
        world(steep, above),
    )
    bodies.advance(0, {})
    states = bodies.advance(5000 * MS, dict.fromkeys(("below", "above"), Twist(1.0)))
    assert states["below"].position_m == pytest.approx((5 - 0.3, 0.0, 0.0), abs=1e-6)
    assert states["above"].position_m == pytest.approx((15.0, 0.0, 6.0), abs=1e-6)


def test_the_sides_of_a_ramp_are_walls_and_edges() -> None:
    state_at_edge = state_after(rover(10.0, 1.0, heading_deg=90.0), 5000, Twist(1.0))
    assert state_at_edge.position_m == pytest.approx((10.0, 2.0, 1.0), abs=1e-6)
    state_at_wall = state_after(rover(10.0, -4.0, heading_deg=90.0), 5000, Twist(1.0))
    assert state_at_wall.position_m == pytest.approx((10.0, -2.0 - 0.3, 0.0), abs=1e-6)


@pytest.mark.parametrize("grade_offset", [0.0, -1e-15, -1e-12, -1e-6, -0.01])
@pytest.mark.parametrize("twist", [Twist(1.0), Twist(-1.0), Twist(0.5, 0.5), Twist(0.0, 1.0)])
@pytest.mark.parametrize("heading_rad", [0.0, math.pi, 1.0])
def test_a_ramp_that_needs_all_of_the_friction_causes_no_error(
    grade_offset: float, twist: Twist, heading_rad: float
) -> None:
    """If the slope uses all of the friction, the speed cannot be changed; the robot may continue to roll."""
    grade = HUSKY_A200.friction + grade_offset
    hill = world({"name": "hill", "kind": "ramp", "centre_m": (5, 0), "size_m": (10, 10, 10 * grade)})
    bodies = Bodies({"a": DifferentialDrive(HUSKY_A200, (5.0, 0.0), heading_rad)}, hill)
    place_m = bodies.advance(0, {})["a"].position_m
    for number in range(1, 20):
        state = bodies.advance(number * 50_000_000, {"a": twist})["a"]
        assert all(map(math.isfinite, (*state.position_m, *state.velocity_m_s)))
        assert math.hypot(*state.velocity_m_s) <= 1.0 + 1e-9
    if not grade_offset and not twist.turn_rad_s and heading_rad == 0.0 and twist.forward_m_s > 0:
        assert state.position_m == place_m, "the robot does not move uphill"
