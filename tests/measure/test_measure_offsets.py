"""The estimated clock offset compared with exchanges whose true offset is given."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.robot_clock import Exchange, offset, parse_date

S = 10**9
OFFSET_S = st.floats(min_value=-1e5, max_value=1e5)
# Delays of the request and of the response in nanoseconds.
DELAYS_NS = st.lists(st.tuples(st.integers(0, 2 * S), st.integers(0, 2 * S)), min_size=1, max_size=8)


def test_the_fastest_exchange_gives_midpoint_and_half_its_round_trip() -> None:
    slow = Exchange(request_ns=0, robot_ns=3 * S, response_ns=2 * S)
    # The request was sent at 10 s and answered at 10.4 s; at the midpoint, 10.2 s, the robot's clock showed 15 s.
    fast = Exchange(request_ns=10 * S, robot_ns=15 * S, response_ns=10 * S + 4 * S // 10)
    estimate = offset([slow, fast])
    assert estimate.offset_s == pytest.approx(4.8)
    assert estimate.error_s == pytest.approx(0.2)


def test_a_clock_with_a_resolution_of_seconds_increases_the_uncertainty() -> None:
    # The robot's clock was between 100 and 101 s when the laptop's was between 90 and 90.2 s.
    estimate = offset([Exchange(90 * S, 100 * S, 90 * S + S // 5, resolution_ns=S)])
    assert estimate.offset_s == pytest.approx(10.4)
    assert estimate.error_s == pytest.approx(0.6)


@given(true_s=OFFSET_S, delays_ns=DELAYS_NS, has_whole_seconds=st.booleans())
def test_the_true_offset_is_within_the_error(
    true_s: float, delays_ns: list[tuple[int, int]], has_whole_seconds: bool
) -> None:
    true_ns = round(true_s * S)
    exchanges = []
    request_ns = 1_700_000_000 * S
    for forward_ns, return_ns in delays_ns:
        robot_time_ns = request_ns + forward_ns + true_ns
        robot_ns, resolution_ns = (robot_time_ns // S * S, S) if has_whole_seconds else (robot_time_ns, 0)
        exchanges.append(Exchange(request_ns, robot_ns, request_ns + forward_ns + return_ns, resolution_ns))
        request_ns += forward_ns + return_ns
    estimate = offset(exchanges)
    assert abs(estimate.offset_s - true_ns / S) <= estimate.error_s + 1e-6


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1795216652.775015827\n", (1_795_216_652_775_015_827, 0)),
        ("1795216652.%N\n", (1_795_216_652 * S, S)),  # busybox 1.35
        ("1795216652.N\n", (1_795_216_652 * S, S)),
        ("1795216652\n", (1_795_216_652 * S, S)),
        ("Fri Nov 20 23:14:01 UTC 2026\n", None),
        ("", None),
        ("99999999999999999999.1", None),
    ],
)
def test_output_of_date(text: str, expected: tuple[int, int] | None) -> None:
    assert parse_date(text) == expected


@given(st.text())
def test_any_text_is_parsed_as_a_time_or_none(text: str) -> None:
    parsed = parse_date(text)
    assert parsed is None or parsed[0] >= 0


def test_no_exchange_is_an_error() -> None:
    with pytest.raises(ValueError, match="empty"):
        offset([])
