"""A robot with differential drive, compared with results computed by hand."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.differential_drive import DifferentialDrive
from sim_backends.physics.robot_limits import HUSKY_A200, TURTLEBOT3_BURGER, DriveLimits
from sim_backends.world.motion import State

S = 1_000_000_000
LIMITS = DriveLimits(2.0, 1.0, 2.0, 4.0, radius_m=0.3, height_m=0.4, friction=1e12)


def drive(limits: DriveLimits = LIMITS, heading_rad: float = 0.0, *, step_ns: int = 1_000_000) -> Bodies:
    return Bodies({"a": DifferentialDrive(limits, (0.0, 0.0), heading_rad, antenna_m=0.5)}, step_ns=step_ns)


def state_after(bodies: Bodies, *legs: tuple[float, Twist]) -> State:
    """Give the commands in order, each for its number of seconds, and return the final state."""
    at_ns = 0
    state = bodies.advance(0, {})["a"]
    for seconds, twist in legs:
        at_ns += round(seconds * S)
        state = bodies.advance(at_ns, {"a": twist})["a"]
    return state


def test_acceleration_and_braking_distances_are_v_squared_over_2a() -> None:
    heading = math.radians(30)
    state = state_after(drive(heading_rad=heading), (2.0, Twist(1.5)), (3.0, Twist()))
    # The robot reaches 1.5 m/s after 1.5 s and 1.125 m, has this speed for 0.5 s, and brakes over the same distance.
    path_m = 1.5**2 / 2 + 0.5 * 1.5 + 1.5**2 / 2
    assert state.position_m == pytest.approx((path_m * math.cos(heading), path_m * math.sin(heading), 0.5), abs=1e-12)
    assert state.velocity_m_s == (0.0, 0.0, 0.0)


def test_the_path_at_a_constant_yaw_rate_is_an_exact_arc() -> None:
    bodies = drive(DriveLimits(2.0, 1e9, 2.0, 1e9, radius_m=0.3, height_m=0.4, friction=1e12))
    state_after(bodies, (0.001, Twist(1.0, 0.5)))
    start = bodies.advance(S // 1000, {})["a"]
    assert start.heading_rad is not None
    # A circle of radius v / w = 2 m: after half a turn the robot is a diameter to the left.
    state_after_half_turn = bodies.advance(round((math.pi / 0.5 + 0.001) * S), {})["a"]
    left = -math.sin(start.heading_rad), math.cos(start.heading_rad)
    assert state_after_half_turn.position_m[0] == pytest.approx(start.position_m[0] + 4 * left[0], abs=2e-3)
    assert state_after_half_turn.position_m[1] == pytest.approx(start.position_m[1] + 4 * left[1], abs=2e-6)
    assert math.hypot(*state_after_half_turn.velocity_m_s) == pytest.approx(1.0)


def test_acceleration_on_an_arc_equals_the_integral_of_velocity() -> None:
    """With speed a t and heading w t the position is a (cos(wt) + wt sin(wt) - 1, sin(wt) - wt cos(wt)) / w^2."""
    bodies = drive(DriveLimits(2.0, 0.7, 2.0, 1e9, radius_m=0.3, height_m=0.4, friction=1e12))
    state_after(bodies, (0.001, Twist(0.0, 1.3)))
    start = bodies.advance(S // 1000, {})["a"].heading_rad
    assert start is not None
    state = bodies.advance(S // 1000 + 2 * S, {"a": Twist(2.0, 1.3)})["a"]
    w, t = 1.3, 2.0
    ahead_m = 0.7 * (math.cos(w * t) + w * t * math.sin(w * t) - 1) / w**2
    left = 0.7 * (math.sin(w * t) - w * t * math.cos(w * t)) / w**2
    cos, sin = math.cos(start), math.sin(start)
    assert state.position_m[:2] == pytest.approx((ahead_m * cos - left * sin, ahead_m * sin + left * cos), abs=1e-12)


def test_a_growing_yaw_rate_gives_the_fresnel_integral() -> None:
    """At 1 m/s with a yaw rate that grows by 0.8 rad/s per second the path is a clothoid."""
    bodies = drive(DriveLimits(1.0, 1e9, 2.0, 0.8, radius_m=0.3, height_m=0.4, friction=1e12))
    state_after(bodies, (0.001, Twist(1.0)))
    start_m = bodies.advance(S // 1000, {})["a"].position_m[0]
    state = bodies.advance(S // 1000 + 2 * S, {"a": Twist(1.0, 2.0)})["a"]
    parts = 20_000
    middles = [(number + 0.5) * 2.0 / parts for number in range(parts)]
    east_m = sum(math.cos(0.4 * t * t) for t in middles) * 2.0 / parts
    north_m = sum(math.sin(0.4 * t * t) for t in middles) * 2.0 / parts
    assert state.position_m[:2] == pytest.approx((start_m + east_m, north_m), abs=1e-6)
    assert state.heading_rad == pytest.approx(0.4 * 4.0)


def test_speeds_do_not_exceed_the_limits() -> None:
    state = state_after(drive(TURTLEBOT3_BURGER), (5.0, Twist(9.0, 0.0)))
    assert math.hypot(*state.velocity_m_s) == pytest.approx(0.22)
    bodies = drive(HUSKY_A200)
    state = state_after(bodies, (10.0, Twist(0.0, 9.0)))
    # The robot reaches 2 rad/s after a third of a second.
    assert state.heading_rad == pytest.approx(2.0 * 10 - 2.0**2 / 6 / 2, abs=1e-6)
    assert state.position_m == (0.0, 0.0, 0.5)


@pytest.mark.parametrize("command", [Velocity(), Twist(math.nan), Twist(0.0, math.inf), "ahead"])
def test_an_unsuitable_command_is_rejected(command: object) -> None:
    bodies = drive()
    with pytest.raises(ConfigurationError, match="a robot on wheels cannot follow"):
        bodies.advance(S, {"a": command})


TWISTS = st.builds(Twist, st.floats(-3, 3), st.floats(-3, 3))


@given(st.lists(st.tuples(st.floats(0.001, 1.0), TWISTS), min_size=1, max_size=6), st.sampled_from([1, 7, 50]))
def test_extrapolation_errors_are_within_the_limit(legs: list[tuple[float, Twist]], step_ms: int) -> None:
    bodies = drive(step_ns=step_ms * 1_000_000)
    start, at_ns = bodies.advance(0, {})["a"], 0
    limit = bodies.limits_m_s2["a"]
    for seconds, twist in legs:
        for part in (0.3, 0.7):
            at_ns += round(part * seconds * S)
            state = bodies.advance(at_ns, {"a": twist})["a"]
            t = at_ns // bodies.step_ns * bodies.step_ns / S
            assert math.dist(state.velocity_m_s, start.velocity_m_s) <= limit * t + 1e-9
            extrapolated_m = [metres + v * t for metres, v in zip(start.position_m, start.velocity_m_s, strict=True)]
            assert math.dist(state.position_m, extrapolated_m) <= limit * t * t / 2 + 1e-9
