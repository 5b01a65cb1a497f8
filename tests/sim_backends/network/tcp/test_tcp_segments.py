"""Ranges of sequence numbers, compared with sets of numbers."""

from collections.abc import Sequence
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.tcp.segments import Ranges

spans = st.tuples(st.integers(0, 60), st.integers(1, 12)).map(lambda span: (span[0], span[0] + span[1]))


@given(added_spans=st.lists(spans, max_size=20), limit=st.integers(0, 80))
def test_ranges_are_sets_of_numbers(added_spans: Sequence[tuple[int, int]], limit: int) -> None:
    ranges, numbers = Ranges(), set[int]()
    for first, end in added_spans:
        new_numbers = {number for part in ranges.add(first, end) for number in range(*part)}
        assert new_numbers == set(range(first, end)) - numbers
        numbers |= new_numbers
    stored_spans = list(ranges)
    assert {number for part in stored_spans for number in range(*part)} == numbers
    # They are sorted and neither overlap nor touch.
    assert all(earlier[1] < later[0] for earlier, later in pairwise(stored_spans))
    for number in range(80):
        containing_range = ranges.containing(number)
        assert (containing_range is not None) == (number in numbers)
        assert containing_range is None or containing_range in stored_spans
    ranges.remove_before(limit)
    assert list(ranges) == [part for part in stored_spans if part[1] > limit]
