"""Convoys compared with transfer functions derived by hand, on a network with a constant delay."""

import math

import numpy as np
import pytest

from sim_backends.cosim.policies.sync_policy import SyncPolicy
from sim_backends.cosim.policies.window_policies import (
    EventDriven,
    Scheduled,
    SlidingWindow,
    TimeStepped,
    VariableStepped,
)
from sim_backends.cosim.studies import formation
from sim_backends.cosim.studies.intervals import Floats
from tests.helpers.convoys import STANDSTILL_M, positions_m

HEADWAY_S, GAIN_PER_S, RATE_RAD_S = 0.3, 2.0, 2.0
PERIOD_S = math.tau / RATE_RAD_S


def test_the_limit_of_string_stability_is_where_the_gain_exceeds_one() -> None:
    rates_rad_s = np.geomspace(1e-3, 1e3, 2000)
    for headway_s, gain_per_s in ((0.3, 2.0), (1.0, 1.0), (0.5, 0.2)):
        limit_s = formation.longest_delay_s(headway_s, gain_per_s)
        for delay_s in (0.0, 0.5 * limit_s, 0.99 * limit_s):
            gains = formation.gain(rates_rad_s, delay_s=delay_s, headway_s=headway_s, gain_per_s=gain_per_s)
            assert gains.max() <= 1 + 1e-12
        for delay_s in (1.01 * limit_s, 2 * limit_s):
            assert (
                formation.gain(rates_rad_s, delay_s=delay_s, headway_s=headway_s, gain_per_s=gain_per_s).max()
                > 1 + 1e-9
            )


@pytest.mark.parametrize(("delay_s", "is_stable"), [(0.04, True), (0.3, False)])
def test_a_row_amplifies_as_its_transfer_function_predicts(delay_s: float, is_stable: bool) -> None:
    """The limit is 83 ms; one delay is below it and one above it."""
    assert (delay_s < formation.longest_delay_s(HEADWAY_S, GAIN_PER_S)) == is_stable
    settling_time_s = 3 * PERIOD_S
    times_s, places = positions_m(
        EventDriven(), delay_s=delay_s, headway_s=HEADWAY_S, followers=2, seconds=settling_time_s + PERIOD_S
    )
    speeds = formation.speeds_m_s(times_s, places)[times_s >= settling_time_s]
    ratios = formation.amplifications(speeds)
    # A state is sent every 10 ms, and a command is held for 10 ms: half of each adds to the delay.
    expected = formation.gain(
        np.array([RATE_RAD_S]), delay_s=delay_s + 0.01, headway_s=HEADWAY_S, gain_per_s=GAIN_PER_S
    )
    assert ratios == pytest.approx([expected[0]] * 2, rel=0.01)
    assert all((ratio <= 1) == is_stable for ratio in ratios)


def run(policy: SyncPolicy) -> tuple[Floats, Floats]:
    return positions_m(policy, delay_s=0.0537, headway_s=0.5, period_ms=10, seconds=3.0)


def test_the_position_error_of_a_closed_loop_grows_with_the_window() -> None:
    times_s, reference = run(EventDriven())
    assert np.array_equal(run(VariableStepped())[1], reference), "exact, so equal to the last digit"
    for kind in (Scheduled, SlidingWindow, TimeStepped):
        errors_m = [
            np.linalg.norm(run(kind(window_s))[1] - reference, axis=2)[:, 1].max()
            for window_s in (0.011, 0.043, 0.17)
        ]
        assert 0 < errors_m[0] < errors_m[1] < errors_m[2]
    spacing_m = formation.spacing_errors_m(times_s, reference, STANDSTILL_M, 0.5)
    # 1 - Gamma (h s + 1), which is about d s^2 / (s + k), times the 0.1 m by which the leader's position oscillates.
    expected_m = 0.1 * 0.0537 * RATE_RAD_S**2 / math.hypot(RATE_RAD_S, GAIN_PER_S)
    assert np.abs(spacing_m[times_s > 2]).max() == pytest.approx(expected_m, rel=0.2)


def test_the_measures_of_a_row_equal_those_computed_by_hand() -> None:
    times_s = np.linspace(0, 10, 1001)
    leader_m = np.stack([2 * times_s, 0 * times_s, 0 * times_s], axis=-1)
    follower_m = leader_m - np.array([5.0, 0.0, 0.0])
    places = np.stack([leader_m, follower_m], axis=1)
    assert formation.speeds_m_s(times_s, places) == pytest.approx(np.full((1001, 2), 2.0))
    assert formation.spacing_errors_m(times_s, places, 2.0, 1.0) == pytest.approx(np.full((1001, 1), 1.0))
    station = leader_m + np.array([-2.5, 3.0, 14.0])
    assert formation.station_errors_m(places, station, 10.0) == pytest.approx(np.full(1001, 5.0))
    wave = np.sin(times_s)
    assert formation.amplifications(np.stack([wave, 0.5 * wave + 3, 0 * wave], axis=1)) == pytest.approx([0.5, 0.0])
    assert np.isnan(formation.amplifications(np.zeros((10, 2)))).all()
