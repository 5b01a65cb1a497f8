"""Loss recovery of TCP: the retransmission timeout as in RFC 6298, the rate reduction as in RFC 6937, section 3.

In tests of the rate reduction, segments have one byte unless stated.
"""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.tcp.recovery import ProportionalReduction, RoundTrips
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
    round_trips = RoundTrips(TcpOptions(clock_granularity_ns=10 * MS))
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
    timeouts_ms = []
    for _ in range(10):
        round_trips.back_off()
        timeouts_ms.append(round_trips.timeout_ns // MS)
    assert timeouts_ms == [600, 1200, 2400, 4800, 9600, 19_200, 38_400, 76_800, 120_000, 120_000]
    round_trips.sample(100 * MS)
    assert round_trips.timeout_ns == (100 + 4 * 37.5) * MS


@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=50))
def test_integer_arithmetic_stays_close_to_the_real_equations(samples_ns: list[int]) -> None:
    round_trips = RoundTrips(TcpOptions(min_timeout_ns=1, clock_granularity_ns=1))
    smoothed_ns, variation_ns = float(samples_ns[0]), samples_ns[0] / 2
    for count, sample_ns in enumerate(samples_ns):
        round_trips.sample(sample_ns)
        if count:
            variation_ns = 0.75 * variation_ns + 0.25 * abs(smoothed_ns - sample_ns)
            smoothed_ns = 0.875 * smoothed_ns + 0.125 * sample_ns
        assert round_trips.smoothed_ns == pytest.approx(smoothed_ns, abs=20)
        assert round_trips.timeout_ns == pytest.approx(smoothed_ns + max(1, 4 * variation_ns), abs=100)


def test_after_one_loss_every_second_ack_allows_a_segment() -> None:
    # 100 in flight, of which one is lost, and a threshold of 50: every second ACK allows one segment.
    reduction, pipe, sent_bytes = ProportionalReduction(50, 100, 1), 96, []
    for _ in range(90):
        pipe -= 1
        sent_bytes.append(reduction.window_bytes(pipe, 1, is_safe=False) - pipe)
        reduction.on_sent(sent_bytes[-1])
        pipe += sent_bytes[-1]
    assert sent_bytes[:8] == [1, 0, 1, 0, 1, 0, 1, 0]
    assert pipe == 51  # 96 - 90 + 45


def test_after_many_losses_each_ack_allows_what_it_delivers_and_a_safe_ack_one_more() -> None:
    # 60 of 100 are lost: the bytes in flight are below the threshold from the start.
    reduction = ProportionalReduction(50, 100, 1)
    assert reduction.window_bytes(37, 1, is_safe=False) == 38
    reduction.on_sent(1)
    assert reduction.window_bytes(37, 1, is_safe=False) == 38
    reduction.on_sent(1)
    assert reduction.window_bytes(37, 1, is_safe=True) == 39
    reduction.on_sent(2)
    # Never beyond the threshold.
    assert reduction.window_bytes(49, 9, is_safe=True) == 50


@given(st.lists(st.tuples(st.integers(1, 3), st.integers(0, 3)), max_size=80))
def test_no_more_is_sent_than_arrives_while_losses_are_detected(acks: list[tuple[int, int]]) -> None:
    reduction, pipe, sent_bytes, arrived_bytes = ProportionalReduction(50, 100, 1), 97, 0, 0
    for delivered_bytes, lost_bytes in acks:
        arrived_bytes += delivered_bytes
        pipe = max(pipe - delivered_bytes - lost_bytes, 0)
        allowed_bytes = reduction.window_bytes(pipe, delivered_bytes, is_safe=False) - pipe
        reduction.on_sent(allowed_bytes)
        pipe, sent_bytes = pipe + allowed_bytes, sent_bytes + allowed_bytes
        assert 0 <= sent_bytes <= arrived_bytes


def test_at_the_threshold_no_segment_is_sent() -> None:
    # The proportional share, which applies above the threshold, would allow one segment.
    assert ProportionalReduction(50, 100, 1).window_bytes(50, 1, is_safe=True) == 50
    assert ProportionalReduction(50, 100, 1).window_bytes(51, 1, is_safe=True) == 52


def test_a_sender_that_sent_more_than_arrived_waits() -> None:
    for pipe in (60, 40):
        reduction = ProportionalReduction(50, 100, 1)
        reduction.on_sent(3)
        assert reduction.window_bytes(pipe, 1, is_safe=False) == pipe


def test_a_safe_ack_allows_one_segment_more_than_it_delivers() -> None:
    """The allowed amount is MAX(prr_delivered - prr_out, DeliveredData) + MSS, in bytes, for any earlier amount."""
    reduction = ProportionalReduction(50_000, 100_000, 1448)
    reduction.on_sent(9 * 1448)
    assert reduction.window_bytes(10_000, 2 * 1448, is_safe=True) == 10_000 + 3 * 1448
    assert reduction.window_bytes(10_000, 2 * 1448, is_safe=False) == 10_000
    # After 15 more segments were delivered, 16 may be sent: DeliveredData + MSS.
    assert reduction.window_bytes(10_000, 15 * 1448, is_safe=True) == 10_000 + 16 * 1448
    reduction.on_sent(5 * 1448)
    assert reduction.window_bytes(10_000, 1448, is_safe=True) == 10_000 + 7 * 1448


STEPS = st.lists(st.tuples(st.integers(0, 120), st.integers(0, 9), st.booleans(), st.integers(0, 9)), max_size=30)


@given(st.integers(1, 100), st.integers(1, 100), st.integers(1, 5), STEPS)
def test_the_window_equals_the_equations_of_the_rfc(
    threshold: int, flight: int, segment: int, steps: list[tuple[int, int, bool, int]]
) -> None:
    reduction, total_delivered_bytes, total_sent_bytes = ProportionalReduction(threshold, flight, segment), 0, 0
    for pipe, delivered_bytes, is_safe, sent_bytes in steps:
        total_delivered_bytes += delivered_bytes
        if pipe > threshold:
            count = math.ceil(Fraction(total_delivered_bytes * threshold, flight)) - total_sent_bytes
        else:
            limit = total_delivered_bytes - total_sent_bytes
            if is_safe:
                limit = max(limit, delivered_bytes) + segment
            count = min(threshold - pipe, limit)
        assert reduction.window_bytes(pipe, delivered_bytes, is_safe=is_safe) == max(pipe, pipe + count)
        reduction.on_sent(sent_bytes)
        total_sent_bytes += sent_bytes
