"""The clock offset against exchanges whose true offset is known."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.offsets import Exchange, offset, parse_date

S = 10**9
OFFSET_S = st.floats(min_value=-1e5, max_value=1e5)
# There, the way of the question, and back: each in nanoseconds.
WAYS_NS = st.lists(st.tuples(st.integers(0, 2 * S), st.integers(0, 2 * S)), min_size=1, max_size=8)


def test_the_fastest_exchange_gives_midpoint_and_half_its_round_trip() -> None:
    slow = Exchange(asked_ns=0, robot_ns=3 * S, answered_ns=2 * S)
    # Asked at 10 s, answered at 10.4 s; at the midpoint, 10.2 s, the robot's clock said 15 s.
    fast = Exchange(asked_ns=10 * S, robot_ns=15 * S, answered_ns=10 * S + 4 * S // 10)
    found = offset([slow, fast])
    assert found.offset_s == pytest.approx(4.8)
    assert found.error_s == pytest.approx(0.2)


def test_a_clock_that_tells_seconds_only_stands_for_the_second_after_it() -> None:
    # The robot's clock was between 100 and 101 s when the laptop's was between 90 and 90.2 s.
    found = offset([Exchange(90 * S, 100 * S, 90 * S + S // 5, resolution_ns=S)])
    assert found.offset_s == pytest.approx(10.4)
    assert found.error_s == pytest.approx(0.6)


@given(true_s=OFFSET_S, ways=WAYS_NS, whole_seconds=st.booleans())
def test_the_true_offset_is_never_further_away_than_the_error(
    true_s: float, ways: list[tuple[int, int]], whole_seconds: bool
) -> None:
    true_ns = round(true_s * S)
    exchanges = []
    asked_ns = 1_700_000_000 * S
    for there, back in ways:
        read = asked_ns + there + true_ns
        robot_ns, resolution_ns = (read // S * S, S) if whole_seconds else (read, 0)
        exchanges.append(Exchange(asked_ns, robot_ns, asked_ns + there + back, resolution_ns))
        asked_ns += there + back
    found = offset(exchanges)
    assert abs(found.offset_s - true_ns / S) <= found.error_s + 1e-6


@pytest.mark.parametrize(
    ("said", "read"),
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
def test_what_date_says(said: str, read: tuple[int, int] | None) -> None:
    assert parse_date(said) == read


@given(st.text())
def test_any_text_is_a_time_or_none(said: str) -> None:
    read = parse_date(said)
    assert read is None or read[0] >= 0


def test_no_exchange_is_an_error() -> None:
    with pytest.raises(ValueError, match="empty"):
        offset([])
