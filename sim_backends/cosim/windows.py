"""Ends of windows without accumulated rounding errors: fractions of a nanosecond are carried over."""

from typing import Final

_PER_NS: Final = 10**9
"""Attoseconds per nanosecond. Rounding each window to half an attosecond adds up to 0.5 ns after 10^9 windows."""


class Windows:
    """Ends of windows whose lengths are not whole nanoseconds.

    A window ends at the last whole nanosecond that the sum of all lengths so far has reached.
    """

    def __init__(self) -> None:
        self._length_ns = 0.0
        self._whole_ns = self._rest = self._carried = 0

    def end_ns(self, begin_ns: int, length_ns: float) -> int:
        """Return the end of a window of a length that begins at the end of the previous one."""
        if length_ns != self._length_ns:
            self._length_ns = length_ns
            self._whole_ns, self._rest = divmod(round(length_ns * _PER_NS), _PER_NS)
        self._carried += self._rest
        if self._carried < _PER_NS:
            return begin_ns + self._whole_ns
        self._carried -= _PER_NS
        return begin_ns + self._whole_ns + 1
