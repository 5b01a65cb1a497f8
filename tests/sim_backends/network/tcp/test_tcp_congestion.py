"""Congestion windows, compared with the equations of RFC 5681 and RFC 9438."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.tcp.congestion import Cubic, NewReno, cube_root
from sim_backends.network.tcp.tcp_options import TcpOptions

MS = 1_000_000
SECOND = 1000 * MS
MSS = TcpOptions().segment_bytes


def windows(control: NewReno, until_s: float, *, round_trip_ns: int, begin_ns: int = 0) -> list[tuple[float, float]]:
    """Acknowledge a window per round trip; return times in s since the start, and windows in segments."""
    now_ns, samples = begin_ns, []
    while now_ns - begin_ns < until_s * SECOND:
        samples.append(((now_ns - begin_ns) / SECOND, control.window_bytes / MSS))
        acked_bytes = max(MSS, control.window_bytes // 40)
        now_ns += round_trip_ns * acked_bytes // control.window_bytes
        control.on_ack(now_ns, acked_bytes, round_trip_ns)
    return samples


@pytest.mark.parametrize("make", [NewReno, Cubic])
def test_slow_start_grows_by_acknowledged_bytes_up_to_the_threshold(make: Callable[[TcpOptions], NewReno]) -> None:
    control = make(TcpOptions())
    for count in range(40):
        assert control.window_bytes == (10 + count) * MSS
        control.on_ack(count * MS, MSS, 20 * MS)
    control.on_timeout(50 * MSS, is_repeated=False)
    threshold_bytes = control.threshold_bytes
    assert threshold_bytes is not None
    assert control.window_bytes == MSS
    control.on_ack(SECOND, threshold_bytes - MSS, 20 * MS)
    assert control.window_bytes == threshold_bytes
    assert not control.in_slow_start


@pytest.mark.parametrize(
    ("segments", "acked_segments", "growth"), [(1, 1, 1), (1, 2, 1), (2, 2, 2), (2, 3, 2), (None, 9, 9)]
)
def test_the_growth_per_ack_can_be_limited(segments: int | None, acked_segments: int, growth: int) -> None:
    control = NewReno(TcpOptions(bytes_counted_segments=segments))
    control.on_ack(0, acked_segments * MSS, 20 * MS)
    assert control.window_bytes == (10 + growth) * MSS


def test_reno_halves_the_window_and_grows_by_a_segment_per_round_trip() -> None:
    control = NewReno(TcpOptions())
    control.on_loss(80 * MSS)
    assert control.window_bytes == control.threshold_bytes == 40 * MSS
    for at_s, window in windows(control, 2, round_trip_ns=100 * MS):
        assert window == pytest.approx(40 + 10 * at_s, abs=0.6)
    control.on_loss(3 * MSS)
    assert control.window_bytes == 2 * MSS  # never below two segments


def test_a_repeated_timeout_keeps_the_threshold() -> None:
    control = NewReno(TcpOptions())
    control.on_timeout(100 * MSS, is_repeated=False)
    control.on_timeout(MSS, is_repeated=True)
    assert (control.window_bytes, control.threshold_bytes) == (MSS, 50 * MSS)


def cubic_after_a_loss(max_segments: int) -> Cubic:
    """Return a window that was reduced for the first time when it had `max_segments` segments."""
    control = Cubic(TcpOptions(initial_window_segments=max_segments))
    control.on_loss(max_segments * MSS)
    return control


@pytest.mark.parametrize(("max_segments", "round_trip_ms"), [(1000, 100), (400, 100), (300, 200)])
def test_cubic_follows_its_curve(max_segments: int, round_trip_ms: int) -> None:
    control = cubic_after_a_loss(max_segments)
    assert control.window_bytes == max_segments * MSS * 7 // 10
    # RFC 9438: W(t) = C (t - K)^3 + W_max, K = cbrt((W_max - cwnd) / C), with C = 0.4, cwnd = 0.7 W_max.
    plateau_s = (0.3 * max_segments / 0.4) ** (1 / 3)
    for at_s, window in windows(control, 2 * plateau_s, round_trip_ns=round_trip_ms * MS):
        curve = 0.4 * (at_s - plateau_s) ** 3 + max_segments
        assert window == pytest.approx(curve, rel=0.02)
        assert control.cubic_bytes(round(at_s * SECOND)) / MSS == pytest.approx(curve, abs=0.01)


def test_cubic_is_not_slower_than_reno_with_its_reduction() -> None:
    # RFC 9438, 4.3: AIMD with 3 (1 - 0.7) / (1 + 0.7) = 0.53 segments per round trip, and one once W_max is reached.
    control = cubic_after_a_loss(20)
    samples = windows(control, 0.8, round_trip_ns=10 * MS)
    maximum_s = (20 - 14) / (9 / 17) * 0.01
    for at_s, window in samples:
        expected = 14 + 9 / 17 * at_s / 0.01 if at_s < maximum_s else 20 + (at_s - maximum_s) / 0.01
        assert window == pytest.approx(expected, rel=0.03)


def test_cubic_lowers_its_plateau_when_its_peak_falls() -> None:
    control = cubic_after_a_loss(1000)
    control.on_loss(control.window_bytes)  # at 700 of 1000: W_max becomes 700 (1 + 0.7) / 2 = 595
    assert control.window_bytes == 490 * MSS
    plateau_s = ((595 - 490) / 0.4) ** (1 / 3)
    at_s, window = windows(control, plateau_s, round_trip_ns=100 * MS)[-1]
    assert at_s == pytest.approx(plateau_s, rel=0.01)
    assert window == pytest.approx(595, rel=0.005)


def test_cubic_starts_at_its_plateau_after_a_timeout() -> None:
    control = cubic_after_a_loss(1000)
    control.on_timeout(500 * MSS, is_repeated=False)
    control.on_ack(SECOND, 349 * MSS, 100 * MS)
    assert control.window_bytes == control.threshold_bytes == 350 * MSS
    # RFC 9438, 4.8: K is 0 and W_max is the current window. The first ACK of congestion avoidance starts the epoch.
    for at_s, window in windows(control, 8, round_trip_ns=100 * MS, begin_ns=2 * SECOND):
        assert window == pytest.approx(350 + max(0.4 * at_s**3, 9 / 17 * at_s / 0.1), rel=0.02)


def test_idle_time_does_not_advance_the_curve_of_cubic() -> None:
    continuous, idle = cubic_after_a_loss(1000), cubic_after_a_loss(1000)
    windows(continuous, 3, round_trip_ns=100 * MS)
    windows(idle, 3, round_trip_ns=100 * MS)
    idle.on_idle(20 * SECOND)
    expected = windows(continuous, 3, round_trip_ns=100 * MS, begin_ns=3 * SECOND)
    assert windows(idle, 3, round_trip_ns=100 * MS, begin_ns=23 * SECOND) == expected


@given(st.integers(0, 10**90))
def test_the_cube_root_is_exact(number: int) -> None:
    root = cube_root(number)
    assert root**3 <= number < (root + 1) ** 3
