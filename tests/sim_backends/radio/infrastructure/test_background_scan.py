"""Times of scans, compared with those computed by hand for `bgscan="simple:30:-65:300"`."""

import pytest

from sim_backends.radio.infrastructure.background_scan import (
    BackgroundScan,
    estimated_throughput_kbit_s,
    prefers_other,
)

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
    # 70 - 20 (3/4)^n is at least 66 from n = 6 on; it is rounded down to 65 before.
    assert (beacon_count, schedule.next_ns) == (6, 20 * S)
    schedule.on_scan(20 * S)
    schedule.on_scan_end(22 * S)
    assert schedule.next_ns == 52 * S, "the interval starts at the end of a scan"


def test_the_average_stays_below_a_constant_signal_like_that_of_mac80211() -> None:
    """The fixed-point average of 65 and then 66 ends at 65 13/16, because each step is rounded down."""
    schedule = start_schedule()
    for signal_dbm in (-65.0, *[-66.4] * 100):
        schedule.on_beacon(10 * S, signal_dbm)
    assert schedule.level_dbm == -65
    assert schedule.next_ns == 300 * S
    for _ in range(4):
        schedule.on_beacon(11 * S, -66.6)
    assert schedule.level_dbm == -66
    assert schedule.next_ns == 11 * S


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
            schedule.on_scan_end(at_s * S)
        assert schedule.next_ns == {1: 300, 5: 35, 8: 35, 16: 46}[at_s] * S


def test_with_one_interval_the_signal_has_no_effect() -> None:
    schedule = BackgroundScan.start(0, -50.0, threshold_dbm=-65.0, short_ns=S, long_ns=S)
    for number in range(20):
        schedule.on_beacon(number, -50.0 - 2 * number)
    assert schedule.next_ns == S


def test_many_short_scans_are_followed_by_a_long_interval() -> None:
    schedule, times_s = start_schedule(-80.0), []
    for _ in range(12):
        times_s.append(schedule.next_ns // S)
        schedule.on_scan(schedule.next_ns)
        schedule.on_scan_end(schedule.next_ns)
    assert times_s == [30 * number for number in range(1, 12)] + [330 + 300]


# The expected throughputs were computed with the lines of scan.c of wpa_supplicant 2.10.
@pytest.mark.parametrize(
    ("ratio_db", "n_kbit_s", "g_kbit_s"),
    [
        (-1, 1000, 1000),
        (3, 8666, 2000),
        (10, 24000, 24000),
        (12, 30000, 30000),
        (17, 47666, 45000),
        (18, 52000, 48000),
        (21, 59800, 54000),
        (24, 63700, 54000),
        (25, 65000, 54000),
        (60, 65000, 54000),
    ],
)
def test_the_estimated_throughput_is_that_of_wpa_supplicant(ratio_db: int, n_kbit_s: int, g_kbit_s: int) -> None:
    assert estimated_throughput_kbit_s(ratio_db) == n_kbit_s
    assert estimated_throughput_kbit_s(ratio_db, high_throughput=False) == g_kbit_s


MARGINS: dict[tuple[int, bool], str] = {
    (-92, True): "11111111111111122212223334445",
    (-89, True): "11111111111111111122222223444445",
    (-92, False): "11111111111111122222223445555",
    (-89, False): "11111111111111111122222224555555",
}
"""Smallest difference with which wpa_supplicant 2.10 roams, in dB, at signals of -95 dBm, -94 dBm and so on.

The keys are the noise, and True for 802.11n or false for 802.11g. The values were computed with a program that
contains the lines of its scan.c and events.c. At stronger signals it does not roam.
"""


@pytest.mark.parametrize(("noise_dbm", "high_throughput"), MARGINS)
def test_a_handover_needs_the_difference_of_signals_of_wpa_supplicant(
    *, noise_dbm: int, high_throughput: bool
) -> None:
    margins_db = list(map(int, MARGINS[noise_dbm, high_throughput]))
    for current_dbm in range(-95, -40):
        index = current_dbm + 95
        levels_dbm = range(current_dbm + margins_db[index], -20) if index < len(margins_db) else ()
        assert [
            level
            for level in range(-100, -20)
            if prefers_other(current_dbm, level, noise_dbm, high_throughput=high_throughput)
        ] == list(levels_dbm)
