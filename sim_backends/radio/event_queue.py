"""Queue of events in virtual time, and of stations that begin to send once they may."""

import heapq
from collections.abc import Callable
from typing import Any

_Event = tuple[int, int, Callable[..., None], tuple[Any, ...]]
"""When, in ns; which it is of all that were planned; the call and its arguments."""


class EventQueue:
    """Calls at their times; of those for the same nanosecond the one planned first comes first.

    A station that waits for the channel begins later each time the channel becomes busy. So its beginning is kept by
    station, where moving it leaves nothing behind, and not among the events.

    Args:
        begin: Called with the time and the index of a station that begins.

    Attributes:
        beginnings: The beginning, by index, of each station that waits for the channel; the first of each is when.
    """

    def __init__(self, begin: Callable[[int, int], None]) -> None:
        self._begin = begin
        self._heap: list[_Event] = []
        self.beginnings: dict[int, _Event] = {}
        # The earliest of them, None when there is none or it has to be looked for.
        self._earliest: _Event | None = None
        self._order = 0

    def at(self, at_ns: int, call: Callable[..., None], *arguments: object) -> None:
        """Call `call` with `at_ns` and the arguments at `at_ns`."""
        self._order += 1
        heapq.heappush(self._heap, (at_ns, self._order, call, arguments))

    def begin(self, at_ns: int, index: int) -> None:
        """Let the station of this index begin at `at_ns`, and not when it was to begin until now."""
        self._order += 1
        self.beginnings[index] = at_ns, self._order, self._begin, (index,)
        self._earliest = None

    def forget(self, index: int) -> None:
        """Let the station of this index not begin."""
        if self.beginnings.pop(index, None) is not None:
            self._earliest = None

    def next_ns(self) -> int | None:
        """Return when something happens next, None when nothing is planned."""
        event = self._next()
        return None if event is None else event[0]

    def advance(self, now_ns: int) -> None:
        """Let everything happen up to `now_ns`."""
        while (event := self._next()) is not None and event[0] <= now_ns:
            at_ns, _, call, arguments = event
            if self._heap and event is self._heap[0]:
                heapq.heappop(self._heap)
            else:
                del self.beginnings[arguments[0]]
                self._earliest = None
            call(at_ns, *arguments)

    def _next(self) -> _Event | None:
        if self._earliest is None and self.beginnings:
            self._earliest = min(self.beginnings.values())
        heap, earliest = self._heap, self._earliest
        if heap and (earliest is None or heap[0] < earliest):
            return heap[0]
        return earliest
