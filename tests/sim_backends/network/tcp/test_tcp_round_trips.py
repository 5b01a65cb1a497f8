"""The retransmission timeout, compared with the equations of RFC 6298."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.tcp.recovery import RoundTrips
from sim_backends.network.tcp.tcp_options import TcpOptions

MS = 1_000_000


def test_the_timeout_follows_the_equations() -> None:
    round_trips = RoundTrips(TcpOptions())
    assert round_trips.timeout_ns == 1000 * MS
    # SRTT = R, RTTVAR = R / 2, RTO = SRTT + 4 RTTVAR.
    round_trips.sample(100 * MS)
    assert (round_trips.smoothed_ns, round_trips.variation_ns) == (100 * MS, 50 * MS)
    assert round_trips.timeout_ns == 300 * MS
    # RTTVAR = 3/4 50 + 1/4 |100 - 200| = 62.5; SRTT = 7/8 100 + 1/8 200 = 112.5; RTO = 112.5 + 250.
    round_trips.sample(200 * MS)
    assert round_trips.timeout_ns == 362_500_000
    # RTTVAR = 3/4 62.5 + 1/4 |112.5 - 100| = 50; SRTT = 7/8 112.5 + 1/8 100 = 110.9375; RTO = 310.9375.
    round_trips.sample(100 * MS)
    assert round_trips.timeout_ns == 310_937_500


def test_the_variance_term_is_at_least_the_clock_granularity() -> None:
    round_trips = RoundTrips(TcpOptions(clock_ns=10 * MS))
    for _ in range(100):
        round_trips.sample(300 * MS)
    assert round_trips.timeout_ns == 310 * MS


@pytest.mark.parametrize(("round_trip_ms", "timeout_ms"), [(1, 200), (60, 200), (100, 300), (50_000, 120_000)])
def test_the_timeout_has_bounds(round_trip_ms: int, timeout_ms: int) -> None:
    round_trips = RoundTrips(TcpOptions())
    round_trips.sample(round_trip_ms * MS)
    assert round_trips.timeout_ns == timeout_ms * MS


def test_the_timeout_doubles_until_the_next_sample() -> None:
    round_trips = RoundTrips(TcpOptions())
    round_trips.sample(100 * MS)
    backed_off_ms = []
    for _ in range(10):
        round_trips.back_off()
        backed_off_ms.append(round_trips.timeout_ns // MS)
    assert backed_off_ms == [600, 1200, 2400, 4800, 9600, 19_200, 38_400, 76_800, 120_000, 120_000]
    round_trips.sample(100 * MS)
    assert round_trips.timeout_ns == (100 + 4 * 37.5) * MS


@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=50))
def test_integer_arithmetic_stays_close_to_the_real_equations(samples_ns: list[int]) -> None:
    round_trips = RoundTrips(TcpOptions(least_timeout_ns=1, clock_ns=1))
    smoothed, variation = float(samples_ns[0]), samples_ns[0] / 2
    for count, sample_ns in enumerate(samples_ns):
        round_trips.sample(sample_ns)
        if count:
            variation = 0.75 * variation + 0.25 * abs(smoothed - sample_ns)
            smoothed = 0.875 * smoothed + 0.125 * sample_ns
        assert round_trips.smoothed_ns == pytest.approx(smoothed, abs=20)
        assert round_trips.timeout_ns == pytest.approx(smoothed + max(1, 4 * variation), abs=100)
