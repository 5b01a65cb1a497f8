"""The bound of `error_bounded` in decibel, by the log-distance law; that in metres is in test_policies."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.policies.base import PolicyError, Situation
from sim_backends.cosim.policies.error_bounded import ErrorBounded
from sim_backends.world.motion import State

STEP_NS = 1_000_000
EXPONENT = 2.5


def loss_db(metres: float) -> float:
    return 10 * EXPONENT * math.log10(max(metres, 1.0))


def window_ns(apart_m: float, velocity_m_s: tuple[float, float, float], bound_db: float) -> int:
    states = {"a": State((0.0, 0.0, 0.0)), "b": State((apart_m, 0.0, 0.0), velocity_m_s)}
    situation = Situation(0, states, [("a", "b")], None, None, STEP_NS, dict.fromkeys("ab", 0.0))
    return ErrorBounded(longest_s=10.0, bound_db=bound_db, exponent=EXPONENT).next_window(situation)


@given(st.floats(0.1, 200.0), st.floats(0.0, 10.0), st.floats(0.01, 6.0), st.floats(-math.pi, math.pi))
def test_the_loss_of_a_pair_changes_by_no_more_than_the_bound(
    apart_m: float, speed_m_s: float, bound_db: float, course_rad: float
) -> None:
    e_m_s, n_m_s = speed_m_s * math.cos(course_rad), speed_m_s * math.sin(course_rad)
    end_ns = window_ns(apart_m, (e_m_s, n_m_s, 0.0), bound_db)
    if end_ns == STEP_NS:
        return  # the window of one step, in which nothing changes
    later_m = math.hypot(apart_m + e_m_s * end_ns / 1e9, n_m_s * end_ns / 1e9)
    assert abs(loss_db(later_m) - loss_db(apart_m)) <= bound_db * (1 + 1e-9)


def test_who_comes_straight_nearer_uses_the_whole_bound() -> None:
    end_ns = window_ns(50.0, (-2.0, 0.0, 0.0), 1.0)
    assert loss_db(50.0) - loss_db(50.0 - 2.0 * end_ns / 1e9) == pytest.approx(1.0, rel=0.001)


@pytest.mark.parametrize("values", [{"bound_m": 0.0}, {"bound_db": -1.0}, {"exponent": math.nan}])
def test_a_bound_that_is_not_above_0_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(PolicyError, match=r"error_bounded: .* is not above 0"):
        ErrorBounded(**values)
