"""Sorted, disjoint ranges of sequence numbers."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator

Range = tuple[int, int]
"""The first number, and the number after the last."""


class Ranges:
    """A set of numbers, stored as ranges that neither overlap nor touch."""

    def __init__(self) -> None:
        self._firsts: list[int] = []
        self._ends: list[int] = []

    def __iter__(self) -> Iterator[Range]:
        return zip(self._firsts, self._ends, strict=True)

    def __len__(self) -> int:
        return len(self._firsts)

    def add(self, first: int, end: int) -> list[Range]:
        """Add the numbers from `first` up to, but without, `end`; return the parts that are new, in order."""
        begin = bisect_left(self._ends, first)
        after = bisect_right(self._firsts, end)
        new = []
        position = first
        for known_first, known_end in zip(self._firsts[begin:after], self._ends[begin:after], strict=True):
            if position < known_first:
                new.append((position, known_first))
            position = max(position, known_end)
        if position < end:
            new.append((position, end))
        if begin < after:
            first = min(first, self._firsts[begin])
            end = max(end, self._ends[after - 1])
        self._firsts[begin:after] = [first]
        self._ends[begin:after] = [end]
        return new

    def containing(self, number: int) -> Range | None:
        """Return the range that contains `number`, or None."""
        index = bisect_right(self._firsts, number) - 1
        if index < 0 or self._ends[index] <= number:
            return None
        return self._firsts[index], self._ends[index]

    def remove_before(self, number: int) -> None:
        """Remove all ranges that end at or before `number`."""
        count = bisect_right(self._ends, number)
        del self._firsts[:count]
        del self._ends[:count]
