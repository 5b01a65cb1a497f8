"""Queue of events in virtual time, and of the start times of stations that wait for the channel."""

import heapq
from collections.abc import Callable
from typing import Any

_Event = tuple[int, int, Callable[..., None], tuple[Any, ...]]
"""Time in ns, sequence number, function, and its arguments."""


class EventQueue:
    """Calls functions at their times; calls for the same nanosecond run in the order in which they were scheduled.

    The start of a station that waits for the channel is rescheduled each time the channel becomes busy. Starts are
    therefore stored per station, where rescheduling leaves no cancelled events in the heap.

    Args:
        start: Called with the time and the index of a station that starts to send.

    Attributes:
        starts: The scheduled start of each station that waits for the channel, by index; the time is its first item.
    """

    def __init__(self, start: Callable[[int, int], None]) -> None:
        self._start = start
        self._heap: list[_Event] = []
        self.starts: dict[int, _Event] = {}
        # The earliest scheduled start; None if there is none or it must be determined again.
        self._earliest: _Event | None = None
        self._order = 0

    def at(self, at_ns: int, call: Callable[..., None], *arguments: object) -> None:
        """Schedule `call(at_ns, *arguments)` for `at_ns`."""
        self._order += 1
        heapq.heappush(self._heap, (at_ns, self._order, call, arguments))

    def schedule_start(self, at_ns: int, index: int) -> None:
        """Schedule, or reschedule, the station's start of transmission for `at_ns`."""
        self._order += 1
        self.starts[index] = at_ns, self._order, self._start, (index,)
        self._earliest = None

    def cancel_start(self, index: int) -> None:
        """Cancel the station's start of transmission, if one is scheduled."""
        if self.starts.pop(index, None) is not None:
            self._earliest = None

    def next_ns(self) -> int | None:
        """Return the time of the next event, or None if there is none."""
        event = self._next()
        return None if event is None else event[0]

    def advance(self, now_ns: int) -> None:
        """Run all events up to `now_ns`."""
        while (event := self._next()) is not None and event[0] <= now_ns:
            at_ns, _, call, arguments = event
            if self._heap and event is self._heap[0]:
                heapq.heappop(self._heap)
            else:
                del self.starts[arguments[0]]
                self._earliest = None
            call(at_ns, *arguments)

    def _next(self) -> _Event | None:
        if self._earliest is None and self.starts:
            self._earliest = min(self.starts.values())
        heap, earliest = self._heap, self._earliest
        if heap and (earliest is None or heap[0] < earliest):
            return heap[0]
        return earliest
