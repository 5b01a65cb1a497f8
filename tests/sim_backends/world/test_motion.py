"""Waypoints: continuous motion at a constant speed, with corners at the times of their distance."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Vector
from sim_backends.world.motion import STILL, OnGround, State, WayPoints

METRES = st.floats(-1000, 1000).map(lambda metres: round(metres, 3))
POINTS = st.lists(st.tuples(METRES, METRES, METRES), min_size=1, max_size=6)
SPEEDS = st.floats(0.01, 100)
SHARES = st.floats(0, 1)


def state(way_points: WayPoints, time_ns: int) -> State:
    (agent_state,) = way_points.at(time_ns).values()
    return agent_state


def length_m(points: list[Vector]) -> float:
    return sum(math.dist(*leg) for leg in pairwise(points))


@given(points=POINTS, speed_m_s=SPEEDS)
def test_the_duration_is_length_over_speed_and_the_end_is_at_rest(points: list[Vector], speed_m_s: float) -> None:
    way_points = WayPoints("a", points, speed_m_s)
    assert way_points.end_ns == pytest.approx(length_m(points) / speed_m_s * 1e9, abs=1)
    assert state(way_points, -1) == State(points[0])
    assert state(way_points, way_points.end_ns) == state(way_points, way_points.end_ns + 10**12) == State(points[-1])


@given(points=POINTS, speed_m_s=SPEEDS, share=SHARES, later_ns=st.integers(0, 10**9))
def test_the_motion_is_continuous_and_never_faster_than_its_speed(
    points: list[Vector], speed_m_s: float, share: float, later_ns: int
) -> None:
    way_points = WayPoints("a", points, speed_m_s)
    now_ns = round(share * way_points.end_ns)
    distance_m = math.dist(state(way_points, now_ns).position_m, state(way_points, now_ns + later_ns).position_m)
    # Each corner is rounded to a nanosecond.
    assert distance_m <= speed_m_s * (later_ns + len(points)) * 1e-9 + 1e-9


@given(points=POINTS, speed_m_s=SPEEDS, share=SHARES)
def test_the_velocity_is_that_of_the_leg(points: list[Vector], speed_m_s: float, share: float) -> None:
    way_points = WayPoints("a", points, speed_m_s)
    now_ns = round(share * way_points.end_ns)
    current_state = state(way_points, now_ns)
    if now_ns >= way_points.end_ns:
        assert current_state.velocity_m_s == STILL
        return
    # A leg of some nanoseconds has a speed with a large rounding error.
    legs_s = [math.dist(*leg) / speed_m_s for leg in pairwise(points)]
    if min(leg_s for leg_s in legs_s if leg_s) > 1e-6:
        assert math.hypot(*current_state.velocity_m_s) == pytest.approx(speed_m_s, rel=1e-3)
    next_m = state(way_points, now_ns + 1).position_m
    expected = [
        metres + v * 1e-9 for metres, v in zip(current_state.position_m, current_state.velocity_m_s, strict=True)
    ]
    assert math.dist(next_m, expected) <= 1e-9 * 2 * max(speed_m_s, math.hypot(*current_state.velocity_m_s)) + 1e-9


@given(points=POINTS, speed_m_s=SPEEDS, shares=st.lists(SHARES, max_size=5))
def test_states_do_not_depend_on_earlier_calls(points: list[Vector], speed_m_s: float, shares: list[float]) -> None:
    reused_path = WayPoints("a", points, speed_m_s)
    times_ns = [round(share * reused_path.end_ns) for share in shares]
    assert [reused_path.at(time_ns) for time_ns in times_ns] == [
        WayPoints("a", points, speed_m_s).at(time_ns) for time_ns in times_ns
    ]


def test_corners_are_passed_at_the_time_of_their_distance() -> None:
    way_points = WayPoints("a", [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 4.0, 0.0)], 2.0)
    assert way_points.at(1_500_000_000) == {"a": State((3.0, 0.0, 0.0), (0.0, 2.0, 0.0))}
    assert way_points.at(1_499_999_999)["a"].velocity_m_s == (2.0, 0.0, 0.0)
    assert way_points.at(2_500_000_000)["a"].position_m == (3.0, 2.0, 0.0)
    assert way_points.end_ns == 3_500_000_000


def test_on_the_ground_the_height_is_that_of_the_ground() -> None:
    way_points = WayPoints("a", [(0.0, 0.0, 9.0), (2.0, 0.0, 9.0)], 1.0)
    ground = OnGround(way_points, lambda place_m: 0.5 if place_m[0] > 1 else 0.0)
    assert ground.at(500_000_000) == {"a": State((0.5, 0.0, 0.0), (1.0, 0.0, 0.0))}
    assert ground.at(1_500_000_000)["a"].position_m == (1.5, 0.0, 0.5)
    assert ground.end_ns == way_points.end_ns


@pytest.mark.parametrize(("points", "speed_m_s"), [([], 1.0), ([STILL], 0.0), ([STILL], -1.0), ([STILL], math.nan)])
def test_an_invalid_path_is_rejected(points: list[Vector], speed_m_s: float) -> None:
    with pytest.raises(ValueError, match="use a point and a speed above 0"):
        WayPoints("a", points, speed_m_s)
