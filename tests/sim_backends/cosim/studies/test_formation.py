"""Position errors of followers on known paths."""

import math

import numpy as np
import pytest

from sim_backends.cosim.scenario.loading import load_scenario
from sim_backends.cosim.studies.formation import (
    NO_FORMATION,
    Formation,
    Tracks,
    compute_formation,
    has_followers,
    mean_formation,
    tracks_of,
)
from sim_backends.world.motion import State

TIMES_S = np.arange(0, 20.0, 0.1)


def tracks(gap_m: float, above_m: float) -> Tracks:
    """Return a convoy that drives east at 1 m/s plus an oscillation; the follower's is half the leader's."""
    oscillation_m = np.sin(math.tau * TIMES_S / 10)
    zero_m = np.zeros_like(TIMES_S)
    leader = np.stack([TIMES_S + 0.2 * oscillation_m, zero_m, zero_m], axis=-1)
    follower = np.stack([TIMES_S - gap_m + 0.1 * oscillation_m, zero_m, zero_m], axis=-1)
    drone = (leader + follower) / 2 + (0.0, 0.0, above_m)
    return Tracks(("drone", "follower", "leader"), TIMES_S, np.stack([drone, follower, leader], axis=1))


def test_the_shipped_convoy_is_measured_with_the_distances_of_its_file() -> None:
    """The file states 2 m and 1 s behind, and 8 m above: at 1 m/s the desired gap is 3 m."""
    scenario = load_scenario("convoy")
    result = compute_formation(scenario, tracks(gap_m=3.0, above_m=8.5))
    assert (result.station_mean_m, result.station_max_m) == pytest.approx((0.5, 0.5))
    assert result.amplification == pytest.approx(0.5, rel=0.01)
    # The gap oscillates by 0.1 sin wt, and the desired gap by 1 s times 0.1 w cos wt: the amplitude of the
    # difference is 0.1 sqrt(1 + w^2).
    amplitude_m = 0.1 * math.hypot(1, math.tau / 10)
    assert result.spacing_max_m == pytest.approx(amplitude_m, rel=0.02)
    assert result.spacing_mean_m == pytest.approx(amplitude_m * 2 / math.pi, rel=0.02)
    assert compute_formation(scenario, tracks(gap_m=4.0, above_m=8.0)).spacing_mean_m == pytest.approx(1, rel=0.02)


def test_a_scenario_without_followers_has_no_formation() -> None:
    scenario = load_scenario("baylands")
    assert not has_followers(scenario)
    assert has_followers(load_scenario("convoy"))
    assert all(math.isnan(value) for value in vars(compute_formation(scenario, tracks(3.0, 8.0))).values())
    assert (
        compute_formation(load_scenario("convoy"), tracks_of([(0, "leader", State((0.0, 0.0, 0.0)))])) is NO_FORMATION
    )


def test_the_mean_of_several_runs_has_means_and_the_largest_maxima() -> None:
    mean = mean_formation([Formation(1.0, 2.0, 3.0, 4.0, 0.5), Formation(3.0, 6.0, 5.0, 1.0, 0.7)])
    assert mean == Formation(2.0, 6.0, 4.0, 4.0, (0.5 + 0.7) / 2)


def test_tracks_of_a_recording_have_every_agent_at_every_time() -> None:
    rows = [(0, "b", 0.0), (0, "a", 5.0), (10**8, "b", 1.0), (10**8, "a", 5.0)]
    recorded_tracks = tracks_of((at_ns, name, State((east_m, 0.0, 0.0))) for at_ns, name, east_m in rows)
    assert (recorded_tracks.names, recorded_tracks.times_s.tolist()) == (("b", "a"), [0.0, 0.1])
    assert recorded_tracks.positions_m[:, :, 0].tolist() == [[0.0, 5.0], [1.0, 5.0]]
    assert tracks_of([]).positions_m.shape == (0, 0, 3)
