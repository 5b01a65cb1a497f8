"""Times of scans, compared with those computed by hand for `bgscan="simple:30:-65:300"`."""

import pytest

from sim_backends.radio.infrastructure.background_scan import BackgroundScan, required_difference_db

S = 10**9


def start_schedule(signal_dbm: float = -50.0) -> BackgroundScan:
    return BackgroundScan.start(0, signal_dbm, threshold_dbm=-65.0, short_ns=30 * S, long_ns=300 * S)


@pytest.mark.parametrize(("signal_dbm", "next_s"), [(-50.0, 300), (-65.0, 300), (-66.0, 30)])
def test_the_first_scan_depends_on_the_signal_at_the_association(signal_dbm: float, next_s: int) -> None:
    assert start_schedule(signal_dbm).next_ns == next_s * S


def test_a_signal_that_falls_below_the_threshold_starts_a_scan() -> None:
    schedule = start_schedule()
    for beacon in range(10):
        schedule.on_beacon(10 * S + beacon, -50.0)
    assert schedule.next_ns == 300 * S
    beacon_count = 0
    while schedule.next_ns == 300 * S:
        beacon_count += 1
        schedule.on_beacon(20 * S, -70.0)
    # -70 + 20 (3/4)^n is below -65 from n = 5 on.
    assert (beacon_count, schedule.next_ns) == (5, 20 * S)
    schedule.on_scan(20 * S)
    assert schedule.next_ns == 50 * S


def test_a_signal_that_rises_above_the_threshold_by_the_hysteresis_ends_short_intervals() -> None:
    schedule = start_schedule(-70.0)
    for beacon in range(10):
        schedule.on_beacon(5 * S + beacon, -66.0)
    assert schedule.next_ns == 30 * S
    for beacon in range(60):
        schedule.on_beacon(6 * S + beacon, -63.0)
    assert schedule.next_ns == 30 * S, "3 dB are less than the hysteresis"
    for _ in range(60):
        schedule.on_beacon(7 * S, -60.0)
    assert schedule.next_ns == 307 * S


def test_a_further_fall_scans_again_at_most_every_ten_seconds() -> None:
    schedule = start_schedule()
    for signal_dbm, at_s in ((-50.0, 1), (-70.0, 5), (-80.0, 8), (-90.0, 16)):
        for _ in range(60):
            schedule.on_beacon(at_s * S, signal_dbm)
        if schedule.next_ns == at_s * S:
            schedule.on_scan(at_s * S)
        assert schedule.next_ns == {1: 300, 5: 35, 8: 35, 16: 46}[at_s] * S


def test_many_short_scans_are_followed_by_a_long_interval() -> None:
    schedule, times_s = start_schedule(-80.0), []
    for _ in range(12):
        times_s.append(schedule.next_ns // S)
        schedule.on_scan(schedule.next_ns)
    assert times_s == [30 * number for number in range(1, 12)] + [330 + 300]


@pytest.mark.parametrize(("current_dbm", "margin_db"), [(-86, 1), (-85, 2), (-80, 3), (-75, 4), (-70, 5), (-40, 5)])
def test_the_required_margin_increases_with_the_current_signal(current_dbm: float, margin_db: float) -> None:
    assert required_difference_db(current_dbm) == margin_db
