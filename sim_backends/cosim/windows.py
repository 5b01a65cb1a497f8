"""Lengths of windows, exactly: what is less than a nanosecond is carried over to the next."""

from typing import Final

_PER_NS: Final = 10**9
"""Attoseconds: a rounding per window of half of one is 0.5 ns after 10^9 windows."""


class Windows:
    """The ends of windows whose lengths are no whole nanoseconds.

    A window ends at the last whole nanosecond that the sum of all lengths so far has reached.
    """

    def __init__(self) -> None:
        self._length_ns = 0.0
        self._whole_ns = self._rest = self._carried = 0

    def end_ns(self, begin_ns: int, length_ns: float) -> int:
        """Return when a window of a length ends that begins where the one before ended."""
        if length_ns != self._length_ns:
            self._length_ns = length_ns
            self._whole_ns, self._rest = divmod(round(length_ns * _PER_NS), _PER_NS)
        self._carried += self._rest
        if self._carried < _PER_NS:
            return begin_ns + self._whole_ns
        self._carried -= _PER_NS
        return begin_ns + self._whole_ns + 1
