"""Way-points: continuous, at the speed that was asked for, and at each corner when its distance says."""

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


def state(way: WayPoints, time_ns: int) -> State:
    (only,) = way.at(time_ns).values()
    return only


def length_m(points: list[Vector]) -> float:
    return sum(math.dist(*leg) for leg in pairwise(points))


@given(points=POINTS, speed_m_s=SPEEDS)
def test_the_way_takes_its_length_at_that_speed_and_ends_at_rest(points: list[Vector], speed_m_s: float) -> None:
    way = WayPoints("a", points, speed_m_s)
    assert way.end_ns == pytest.approx(length_m(points) / speed_m_s * 1e9, abs=1)
    assert state(way, -1) == State(points[0])
    assert state(way, way.end_ns) == state(way, way.end_ns + 10**12) == State(points[-1])


@given(points=POINTS, speed_m_s=SPEEDS, share=SHARES, later_ns=st.integers(0, 10**9))
def test_it_is_continuous_and_never_faster(
    points: list[Vector], speed_m_s: float, share: float, later_ns: int
) -> None:
    way = WayPoints("a", points, speed_m_s)
    now_ns = round(share * way.end_ns)
    gone_m = math.dist(state(way, now_ns).position_m, state(way, now_ns + later_ns).position_m)
    # Each corner is rounded to a nanosecond.
    assert gone_m <= speed_m_s * (later_ns + len(points)) * 1e-9 + 1e-9


@given(points=POINTS, speed_m_s=SPEEDS, share=SHARES)
def test_the_velocity_is_that_of_the_leg(points: list[Vector], speed_m_s: float, share: float) -> None:
    way = WayPoints("a", points, speed_m_s)
    now_ns = round(share * way.end_ns)
    here = state(way, now_ns)
    if now_ns >= way.end_ns:
        assert here.velocity_m_s == STILL
        return
    # A leg of some nanoseconds is as fast as rounding lets it be.
    legs_s = [math.dist(*leg) / speed_m_s for leg in pairwise(points)]
    if min(leg_s for leg_s in legs_s if leg_s) > 1e-6:
        assert math.hypot(*here.velocity_m_s) == pytest.approx(speed_m_s, rel=1e-3)
    soon = state(way, now_ns + 1).position_m
    expected = [at + v * 1e-9 for at, v in zip(here.position_m, here.velocity_m_s, strict=True)]
    assert math.dist(soon, expected) <= 1e-9 * 2 * max(speed_m_s, math.hypot(*here.velocity_m_s)) + 1e-9


@given(points=POINTS, speed_m_s=SPEEDS, shares=st.lists(SHARES, max_size=5))
def test_what_was_asked_before_changes_nothing(points: list[Vector], speed_m_s: float, shares: list[float]) -> None:
    asked = WayPoints("a", points, speed_m_s)
    times_ns = [round(share * asked.end_ns) for share in shares]
    assert [asked.at(time_ns) for time_ns in times_ns] == [
        WayPoints("a", points, speed_m_s).at(time_ns) for time_ns in times_ns
    ]


def test_corners_are_passed_when_their_distance_says() -> None:
    way = WayPoints("a", [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 4.0, 0.0)], 2.0)
    assert way.at(1_500_000_000) == {"a": State((3.0, 0.0, 0.0), (0.0, 2.0, 0.0))}
    assert way.at(1_499_999_999)["a"].velocity_m_s == (2.0, 0.0, 0.0)
    assert way.at(2_500_000_000)["a"].position_m == (3.0, 2.0, 0.0)
    assert way.end_ns == 3_500_000_000


def test_on_the_ground_the_height_is_the_grounds() -> None:
    way = WayPoints("a", [(0.0, 0.0, 9.0), (2.0, 0.0, 9.0)], 1.0)
    ground = OnGround(way, lambda place_m: 0.5 if place_m[0] > 1 else 0.0)
    assert ground.at(500_000_000) == {"a": State((0.5, 0.0, 0.0), (1.0, 0.0, 0.0))}
    assert ground.at(1_500_000_000)["a"].position_m == (1.5, 0.0, 0.5)
    assert ground.end_ns == way.end_ns


@pytest.mark.parametrize(("points", "speed_m_s"), [([], 1.0), ([STILL], 0.0), ([STILL], -1.0), ([STILL], math.nan)])
def test_no_way_is_refused(points: list[Vector], speed_m_s: float) -> None:
    with pytest.raises(ValueError, match="no way"):
        WayPoints("a", points, speed_m_s)
