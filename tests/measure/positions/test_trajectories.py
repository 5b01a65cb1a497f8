"""Trajectories: unknown positions, and distances and speeds compared with closed forms and dense sums."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fieldkit.measure.positions import trajectories
from fieldkit.measure.positions.trajectories import Trajectory, separation_between, stationary

S = 10**9
EPOCH_NS = 1_795_365_294 * S
"""A realistic time."""
ORIGIN = stationary(np.zeros(3))


def trajectory(*samples: tuple[float, float, float], gap_s: float = 3.0) -> Trajectory:
    """Return a trajectory on the ground. A sample has seconds, and metres east and north."""
    times_ns = np.array([EPOCH_NS + round(at_s * S) for at_s, *_ in samples])
    return Trajectory(times_ns, np.array([(east, north, 0.0) for _, east, north in samples]), round(gap_s * S))


def at_ns(seconds: float) -> int:
    return EPOCH_NS + round(seconds * S)


def test_minimum_and_mean_distance_of_a_passing_robot_equal_the_closed_form() -> None:
    passing_robot = trajectory((0, -4, 3), (2, 0, 3), (4, 4, 3))
    separation = separation_between(ORIGIN, passing_robot, at_ns(0), at_ns(4))
    integral = 4 * 5 / 2 + 9 / 2 * math.asinh(4 / 3)  # integral of sqrt(x^2 + 9) from 0 to 4
    assert separation.distance_start_m == separation.distance_max_m == pytest.approx(5)
    assert separation.distance_min_m == pytest.approx(3)
    assert separation.distance_mean_m == pytest.approx(integral / 4)
    assert separation.relative_speed_m_s == pytest.approx(2)
    assert separation.sender_speed_m_s == 0


def test_the_smallest_distance_may_be_between_two_samples() -> None:
    assert separation_between(
        ORIGIN, trajectory((0, -4, 3), (4, 4, 3), gap_s=5), at_ns(0), at_ns(4)
    ).distance_min_m == pytest.approx(3)


def test_two_robots_that_move_together_have_no_relative_speed() -> None:
    source, destination = trajectory((0, 0, 0), (2, 2, 0)), trajectory((0, 0, 5), (1, 1, 5), (2, 2, 5))
    separation = separation_between(source, destination, at_ns(0.5), at_ns(1.5))
    assert (separation.distance_min_m, separation.distance_max_m, separation.distance_mean_m) == pytest.approx(
        (5, 5, 5)
    )
    assert separation.relative_speed_m_s == pytest.approx(0, abs=1e-6)
    assert separation.sender_speed_m_s == pytest.approx(1)


def test_a_single_time_has_a_distance_and_the_speed_around_it() -> None:
    separation = separation_between(ORIGIN, trajectory((0, 0, 0), (3, 6, 0)), at_ns(1), at_ns(1))
    assert separation.distance_start_m == separation.distance_mean_m == pytest.approx(2)
    assert separation.relative_speed_m_s == pytest.approx(2)


def test_noise_in_close_samples_is_not_a_speed() -> None:
    noisy_trajectory = trajectory(*((0.001 * n, 10 + 0.001 * (-1) ** n, 0) for n in range(1001)))
    assert separation_between(ORIGIN, noisy_trajectory, at_ns(0), at_ns(1)).relative_speed_m_s < 0.02


@pytest.mark.parametrize(
    ("begin_s", "end_s", "problem"),
    [
        (0, 4, None),
        (1, 1, None),
        (4, 9.5, "have a gap of 5.0 s, but at most 3 s are allowed"),
        (6, 7, "have a gap of 5.0 s, but at most 3 s are allowed"),
        (9.5, 10, None),
        (-1.5, 2, "begin 1.5 s too late"),
        (3, 12, "end 2.0 s too early"),
    ],
)
def test_positions_are_unknown_in_a_gap_and_beyond_the_ends(
    begin_s: float, end_s: float, problem: str | None
) -> None:
    trajectory_with_gap = trajectory((0, 0, 0), (2, 1, 0), (4, 2, 0), (9, 3, 0), (10, 4, 0))
    assert trajectory_with_gap.coverage_problem(at_ns(begin_s), at_ns(end_s)) == problem


COORDINATES = st.floats(-1000, 1000)
TIMES = st.lists(st.integers(0, 10_000), min_size=2, max_size=8, unique=True).map(sorted)


@st.composite
def any_trajectory(draw: st.DrawFn) -> Trajectory:
    times_ms = draw(TIMES)
    positions_m = [(draw(COORDINATES), draw(COORDINATES), draw(COORDINATES)) for _ in times_ms]
    return Trajectory(np.array([EPOCH_NS + 10**6 * time_ms for time_ms in times_ms]), np.array(positions_m), 2**62)


@given(any_trajectory(), any_trajectory(), st.data())
def test_distances_equal_a_dense_sum(source: Trajectory, destination: Trajectory, data: st.DataObject) -> None:
    first = int(max(source.times_ns[0], destination.times_ns[0]))
    last = int(min(source.times_ns[-1], destination.times_ns[-1]))
    assume(last > first)
    start_ns = data.draw(st.integers(first, last - 1))
    end_ns = data.draw(st.integers(start_ns + 1, last))
    separation = separation_between(source, destination, start_ns, end_ns)
    times_ns = np.linspace(start_ns - EPOCH_NS, end_ns - EPOCH_NS, 4001).astype(np.int64) + EPOCH_NS
    dense_distances_m = np.linalg.norm(destination.at_m(times_ns) - source.at_m(times_ns), axis=1)
    assert separation.distance_start_m == pytest.approx(dense_distances_m[0], abs=1e-6)
    assert separation.distance_min_m <= dense_distances_m.min() + 1e-6
    assert separation.distance_min_m <= separation.distance_mean_m + 1e-6 <= separation.distance_max_m + 2e-6
    # The error of the sum is at most the change of the distance between two consecutive times.
    max_change_m = max(float(np.abs(np.diff(dense_distances_m)).max()), 1e-6)
    assert separation.distance_min_m == pytest.approx(dense_distances_m.min(), abs=2 * max_change_m + 1e-3)
    assert separation.distance_max_m == pytest.approx(dense_distances_m.max(), abs=2 * max_change_m + 1e-3)
    assert separation.distance_mean_m == pytest.approx(
        np.trapezoid(dense_distances_m) / 4000, abs=2 * max_change_m + 1e-3
    )


@given(any_trajectory(), any_trajectory(), st.integers(-(10**15), 10**15))
def test_results_do_not_depend_on_absolute_time(source: Trajectory, destination: Trajectory, shift_ns: int) -> None:
    first = int(max(source.times_ns[0], destination.times_ns[0]))
    last = int(min(source.times_ns[-1], destination.times_ns[-1]))
    assume(last > first)
    shifted_source, shifted_destination = (
        Trajectory(each_trajectory.times_ns + shift_ns, each_trajectory.places_m, each_trajectory.gap_ns)
        for each_trajectory in (source, destination)
    )
    assert separation_between(
        shifted_source, shifted_destination, first + shift_ns, last + shift_ns
    ) == separation_between(source, destination, first, last)


def test_distances_are_given_while_both_positions_are_known() -> None:
    times_ns, metres = trajectories.distances_m(trajectory((0, 0, 0), (2, 2, 0)), trajectory((1, 4, 0), (3, 4, 0)))
    assert (times_ns - EPOCH_NS).tolist() == [S, 2 * S]
    assert metres.tolist() == pytest.approx([3, 2])
    assert (
        trajectories.distances_m(trajectory((0, 0, 0), (1, 0, 0)), trajectory((2, 0, 0), (3, 0, 0)))[0].tolist() == []
    )
