"""Losses computed from wrapping sequence numbers, compared with given losses."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.evidence.sequence import NUMBERS, count_messages

PERIOD_US = 20_000


def sent_messages(count: int, first: int = 0) -> list[tuple[int, int]]:
    """Return messages at 50 Hz as pairs of time and sequence number."""
    return [(number * PERIOD_US, (first + number) % NUMBERS) for number in range(count)]


@given(st.lists(st.booleans(), min_size=10, max_size=900), st.integers(0, 255))
def test_losses_between_the_first_and_the_last_message_are_counted(is_lost_by_index: list[bool], first: int) -> None:
    arrivals = [
        message
        for message, is_lost in zip(sent_messages(len(is_lost_by_index), first), is_lost_by_index, strict=True)
        if not is_lost
    ]
    # A gap of more than a second is not visible in the sequence numbers; it is tested separately.
    if not arrivals or max((after[0] - before[0] for before, after in pairwise(arrivals)), default=0) > 1e6:
        return
    counts = count_messages(arrivals, 0)
    missing = arrivals[-1][0] // PERIOD_US - arrivals[0][0] // PERIOD_US + 1 - len(arrivals)
    assert (counts.messages, counts.lost, counts.repeated) == (len(arrivals), missing, 0)


@given(st.permutations(range(4)), st.integers(0, 255))
def test_late_messages_are_not_lost_and_duplicates_count_once(order: list[int], first: int) -> None:
    arrivals = sent_messages(40, first)
    arrivals[10:14] = [arrivals[10 + index] for index in order]
    arrivals.insert(20, arrivals[19])
    counts = count_messages([(index * PERIOD_US, number) for index, (_, number) in enumerate(arrivals)], 0)
    assert (counts.messages, counts.lost, counts.repeated) == (40, 0, 1)


@pytest.mark.parametrize("n_lost", [40, 51, 200, 255, 256, 257, 700, 3000])
def test_losses_in_a_silence_of_more_than_256_messages_are_computed_from_the_rate(n_lost: int) -> None:
    arrivals = sent_messages(5000)
    counts = count_messages(arrivals[:500] + arrivals[500 + n_lost :], 0)
    assert (counts.messages, counts.lost) == (5000 - n_lost, n_lost)
    assert counts.silence_s == pytest.approx((n_lost + 1) / 50)
    assert counts.rate_hz == pytest.approx(50)


def test_losses_after_the_last_message_are_computed_from_the_rate() -> None:
    counts = count_messages(sent_messages(500), 500 * PERIOD_US + 10_000_000)
    assert counts.lost == pytest.approx(500, abs=1)
    assert counts.silence_s == pytest.approx(10, abs=0.03)


def test_no_message_and_a_single_message_are_counted() -> None:
    assert (count_messages([], 9).messages, count_messages([(1, 2)], 0).messages) == (0, 1)


@given(st.lists(st.tuples(st.integers(0, 2**52), st.integers(0, 255)), max_size=40), st.integers(0, 2**62))
def test_any_numbers_give_valid_counts(arrivals: list[tuple[int, int]], end_us: int) -> None:
    counts = count_messages(arrivals, end_us)
    assert 0 <= counts.messages <= len(arrivals)
    assert counts.lost >= 0
