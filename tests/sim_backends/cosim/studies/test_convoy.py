"""Convoys against transfer functions worked out on paper, on a network whose delay is constant."""

import math

import numpy as np
import pytest

from sim_backends.cosim.policies.base import SyncPolicy
from sim_backends.cosim.policies.event_driven import EventDriven
from sim_backends.cosim.policies.scheduled import Scheduled
from sim_backends.cosim.policies.sliding_window import SlidingWindow
from sim_backends.cosim.policies.time_stepped import TimeStepped
from sim_backends.cosim.policies.variable_stepped import VariableStepped
from sim_backends.cosim.studies import convoy
from sim_backends.cosim.studies.intervals import Floats
from tests.helpers.convoys import MEAN_M_S, STANDSTILL_M, places_m

HEADWAY_S, GAIN_PER_S, RATE_RAD_S = 0.3, 2.0, 2.0
PERIOD_S = math.tau / RATE_RAD_S


def test_the_border_of_string_stability_is_where_the_gain_leaves_one() -> None:
    rates = np.geomspace(1e-3, 1e3, 2000)
    for headway_s, gain_per_s in ((0.3, 2.0), (1.0, 1.0), (0.5, 0.2)):
        border_s = convoy.longest_delay_s(headway_s, gain_per_s)
        for delay_s in (0.0, 0.5 * border_s, 0.99 * border_s):
            gains = convoy.gain(rates, delay_s=delay_s, headway_s=headway_s, gain_per_s=gain_per_s)
            assert gains.max() <= 1 + 1e-12
        for delay_s in (1.01 * border_s, 2 * border_s):
            assert convoy.gain(rates, delay_s=delay_s, headway_s=headway_s, gain_per_s=gain_per_s).max() > 1 + 1e-9


@pytest.mark.parametrize(("delay_s", "stable"), [(0.04, True), (0.3, False)])
def test_a_row_amplifies_or_damps_as_its_transfer_function_says(delay_s: float, stable: bool) -> None:
    """On both sides of the border, which is at 83 ms."""
    assert (delay_s < convoy.longest_delay_s(HEADWAY_S, GAIN_PER_S)) == stable
    settled_s = 3 * PERIOD_S
    times_s, places = places_m(
        EventDriven(), delay_s=delay_s, headway_s=HEADWAY_S, followers=2, seconds=settled_s + PERIOD_S
    )
    speeds = convoy.speeds_m_s(times_s, places)[times_s >= settled_s]
    found = convoy.amplifications(speeds)
    # A state is sent every 10 ms, and a command holds for as long: half of each is delay, too.
    expected = convoy.gain(np.array([RATE_RAD_S]), delay_s=delay_s + 0.01, headway_s=HEADWAY_S, gain_per_s=GAIN_PER_S)
    assert found == pytest.approx([expected[0]] * 2, rel=0.01)
    assert all((ratio <= 1) == stable for ratio in found)


def run(policy: SyncPolicy) -> tuple[Floats, Floats]:
    return places_m(policy, delay_s=0.05, headway_s=0.5, period_ms=50, seconds=4.0)


def test_the_loop_goes_wrong_as_far_as_a_policy_is_wrong_in_time() -> None:
    times_s, reference = run(EventDriven())
    assert np.array_equal(run(VariableStepped())[1], reference), "exact, so the same to the last digit"
    for kind in (Scheduled, SlidingWindow, TimeStepped):
        off_m = [
            np.linalg.norm(run(kind(window_s))[1] - reference, axis=2)[:, 1].max() for window_s in (0.01, 0.04, 0.16)
        ]
        assert 0 < off_m[0] < off_m[1] < off_m[2]
    errors_m = convoy.spacing_errors_m(times_s, reference, STANDSTILL_M, 0.5)
    # It knows its leader's place to a d^2 / 2, d being 50 ms under way and 50 more until the next comes.
    a_m_s2 = 0.2 * RATE_RAD_S
    assert np.abs(errors_m[times_s > 2]).max() < 0.1 * MEAN_M_S
    assert np.abs(errors_m[times_s > 2]).max() > a_m_s2 * 0.05**2 / 2


def test_measures_are_those_of_a_row_that_is_known() -> None:
    times_s = np.linspace(0, 10, 1001)
    lead = np.stack([2 * times_s, 0 * times_s, 0 * times_s], axis=-1)
    behind = lead - np.array([5.0, 0.0, 0.0])
    places = np.stack([lead, behind], axis=1)
    assert convoy.speeds_m_s(times_s, places) == pytest.approx(np.full((1001, 2), 2.0))
    assert convoy.spacing_errors_m(times_s, places, 2.0, 1.0) == pytest.approx(np.full((1001, 1), 1.0))
    station = lead + np.array([-2.5, 3.0, 14.0])
    assert convoy.station_errors_m(places, station, 10.0) == pytest.approx(np.full(1001, 5.0))
    wave = np.sin(times_s)
    assert convoy.amplifications(np.stack([wave, 0.5 * wave + 3, 0 * wave], axis=1)) == pytest.approx([0.5, 0.0])
    assert np.isnan(convoy.amplifications(np.zeros((10, 2)))).all()
