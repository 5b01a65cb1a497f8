"""A robot with a differential drive against what can be worked out on paper."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from sim_backends.physics.bodies import Bodies
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.differential_drive import HUSKY_A200, TURTLEBOT3_BURGER, DifferentialDrive, DriveLimits
from sim_backends.world.motion import State

S = 1_000_000_000
LIMITS = DriveLimits(2.0, 1.0, 2.0, 4.0, radius_m=0.3, height_m=0.4, friction=1e12)


def drive(limits: DriveLimits = LIMITS, heading_rad: float = 0.0, *, step_ns: int = 1_000_000) -> Bodies:
    return Bodies({"a": DifferentialDrive(limits, (0.0, 0.0), heading_rad, antenna_m=0.5)}, step_ns=step_ns)


def after(bodies: Bodies, *legs: tuple[float, Twist]) -> State:
    """Give one command after the other, each for so many seconds."""
    at_ns = 0
    state = bodies.advance(0, {})["a"]
    for seconds, twist in legs:
        at_ns += round(seconds * S)
        state = bodies.advance(at_ns, {"a": twist})["a"]
    return state


def test_it_speeds_up_and_brakes_within_v_squared_over_2a() -> None:
    heading = math.radians(30)
    state = after(drive(heading_rad=heading), (2.0, Twist(1.5)), (3.0, Twist()))
    # To 1.5 m/s in 1.5 s over 1.125 m, 0.5 s at that speed, and as far again to brake.
    way_m = 1.5**2 / 2 + 0.5 * 1.5 + 1.5**2 / 2
    assert state.position_m == pytest.approx((way_m * math.cos(heading), way_m * math.sin(heading), 0.5), abs=1e-12)
    assert state.velocity_m_s == (0.0, 0.0, 0.0)


def test_it_drives_exact_arcs() -> None:
    bodies = drive(DriveLimits(2.0, 1e9, 2.0, 1e9, radius_m=0.3, height_m=0.4, friction=1e12))
    after(bodies, (0.001, Twist(1.0, 0.5)))
    begin = bodies.advance(S // 1000, {})["a"]
    assert begin.heading_rad is not None
    # A circle of radius v / w = 2 m: after half a turn it is a diameter to the left, after a whole one back.
    half = bodies.advance(round((math.pi / 0.5 + 0.001) * S), {})["a"]
    left = -math.sin(begin.heading_rad), math.cos(begin.heading_rad)
    assert half.position_m[0] == pytest.approx(begin.position_m[0] + 4 * left[0], abs=2e-3)
    assert half.position_m[1] == pytest.approx(begin.position_m[1] + 4 * left[1], abs=2e-6)
    assert math.hypot(*half.velocity_m_s) == pytest.approx(1.0)


def test_speeding_up_on_an_arc_is_the_integral_of_velocity() -> None:
    """With speed a t and heading w t the place is a (cos(wt) + wt sin(wt) - 1, sin(wt) - wt cos(wt)) / w^2."""
    bodies = drive(DriveLimits(2.0, 0.7, 2.0, 1e9, radius_m=0.3, height_m=0.4, friction=1e12))
    after(bodies, (0.001, Twist(0.0, 1.3)))
    begin = bodies.advance(S // 1000, {})["a"].heading_rad
    assert begin is not None
    state = bodies.advance(S // 1000 + 2 * S, {"a": Twist(2.0, 1.3)})["a"]
    w, t = 1.3, 2.0
    ahead = 0.7 * (math.cos(w * t) + w * t * math.sin(w * t) - 1) / w**2
    left = 0.7 * (math.sin(w * t) - w * t * math.cos(w * t)) / w**2
    cos, sin = math.cos(begin), math.sin(begin)
    assert state.position_m[:2] == pytest.approx((ahead * cos - left * sin, ahead * sin + left * cos), abs=1e-12)


def test_turning_up_while_it_moves_is_the_fresnel_integral() -> None:
    """At 1 m/s with the rate of turn growing by 0.8 rad/s each second it drives a clothoid."""
    bodies = drive(DriveLimits(1.0, 1e9, 2.0, 0.8, radius_m=0.3, height_m=0.4, friction=1e12))
    after(bodies, (0.001, Twist(1.0)))
    begin_m = bodies.advance(S // 1000, {})["a"].position_m[0]
    state = bodies.advance(S // 1000 + 2 * S, {"a": Twist(1.0, 2.0)})["a"]
    parts = 20_000
    middles = [(number + 0.5) * 2.0 / parts for number in range(parts)]
    east_m = sum(math.cos(0.4 * t * t) for t in middles) * 2.0 / parts
    north_m = sum(math.sin(0.4 * t * t) for t in middles) * 2.0 / parts
    assert state.position_m[:2] == pytest.approx((begin_m + east_m, north_m), abs=1e-6)
    assert state.heading_rad == pytest.approx(0.4 * 4.0)


def test_it_keeps_its_limits() -> None:
    state = after(drive(TURTLEBOT3_BURGER), (5.0, Twist(9.0, 0.0)))
    assert math.hypot(*state.velocity_m_s) == pytest.approx(0.22)
    bodies = drive(HUSKY_A200)
    state = after(bodies, (10.0, Twist(0.0, 9.0)))
    # To 2 rad/s in a third of a second.
    assert state.heading_rad == pytest.approx(2.0 * 10 - 2.0**2 / 6 / 2, abs=1e-6)
    assert state.position_m == (0.0, 0.0, 0.5)


@pytest.mark.parametrize("command", [Velocity(), Twist(math.nan), Twist(0.0, math.inf), "ahead"])
def test_a_command_that_it_cannot_do_is_refused(command: object) -> None:
    bodies = drive()
    with pytest.raises(ConfigurationError, match="a robot on wheels cannot do"):
        bodies.advance(S, {"a": command})


TWISTS = st.builds(Twist, st.floats(-3, 3), st.floats(-3, 3))


@given(st.lists(st.tuples(st.floats(0.001, 1.0), TWISTS), min_size=1, max_size=6), st.sampled_from([1, 7, 50]))
def test_no_place_and_no_velocity_is_off_by_more_than_the_limit_says(
    legs: list[tuple[float, Twist]], step_ms: int
) -> None:
    bodies = drive(step_ns=step_ms * 1_000_000)
    begin, at_ns = bodies.advance(0, {})["a"], 0
    limit = bodies.limits_m_s2["a"]
    for seconds, twist in legs:
        for part in (0.3, 0.7):
            at_ns += round(part * seconds * S)
            state = bodies.advance(at_ns, {"a": twist})["a"]
            t = at_ns // bodies.step_ns * bodies.step_ns / S
            assert math.dist(state.velocity_m_s, begin.velocity_m_s) <= limit * t + 1e-9
            there_m = [here + v * t for here, v in zip(begin.position_m, begin.velocity_m_s, strict=True)]
            assert math.dist(state.position_m, there_m) <= limit * t * t / 2 + 1e-9
