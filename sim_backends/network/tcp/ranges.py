"""Ranges of sequence numbers, kept in order and apart."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator

Range = tuple[int, int]
"""Its first number, and the one after its last."""


class Ranges:
    """A set of numbers as ranges that neither overlap nor touch."""

    def __init__(self) -> None:
        self._firsts: list[int] = []
        self._ends: list[int] = []

    def __iter__(self) -> Iterator[Range]:
        return zip(self._firsts, self._ends, strict=True)

    def __len__(self) -> int:
        return len(self._firsts)

    def add(self, first: int, end: int) -> list[Range]:
        """Add the numbers from `first` to before `end`; return those of them that are new, in order."""
        begin = bisect_left(self._ends, first)
        after = bisect_right(self._firsts, end)
        new = []
        at = first
        for known, known_end in zip(self._firsts[begin:after], self._ends[begin:after], strict=True):
            if at < known:
                new.append((at, known))
            at = max(at, known_end)
        if at < end:
            new.append((at, end))
        if begin < after:
            first = min(first, self._firsts[begin])
            end = max(end, self._ends[after - 1])
        self._firsts[begin:after] = [first]
        self._ends[begin:after] = [end]
        return new

    def around(self, number: int) -> Range | None:
        """Return the range that `number` is in, None if it is in none."""
        index = bisect_right(self._firsts, number) - 1
        if index < 0 or self._ends[index] <= number:
            return None
        return self._firsts[index], self._ends[index]

    def forget_before(self, number: int) -> None:
        """Drop all ranges that end at `number` or before."""
        gone = bisect_right(self._ends, number)
        del self._firsts[:gone]
        del self._ends[:gone]
