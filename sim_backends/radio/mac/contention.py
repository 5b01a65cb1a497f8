"""Contention for the channel: carrier sense, inter-frame space, backoff (IEEE 802.11-2020, 10.3.4, DCF).

The queue of events in virtual time also contains the start times of stations that wait for the channel.
"""

import heapq
from collections.abc import Callable
from typing import Any, Final, Protocol

from sim_backends.radio.phy.modes import CW_MAX, CW_MIN, SLOT_NS

CCA_TIME_NS: Final = 4_000
"""Stations that start within this time of each other do not sense each other and collide: aCCATime, table 17-21."""


class ChannelAccess(Protocol):
    """Carrier sense and backoff of a station, for one queue (`Contention`) or several (`AccessCategories`)."""

    @property
    def busy_until_ns(self) -> int:
        """End of the last frame or reservation that the station has sensed or sent."""

    @property
    def ifs_ns(self) -> int:
        """Inter-frame space before the backoff; 0 if each queue adds an inter-frame space."""

    def earliest_start_ns(self, now_ns: int) -> int:
        """Return the earliest start time of a station with a frame to send at `now_ns`, if the channel stays idle.

        Slots that were idle until `now_ns` are counted down.
        """

    def on_busy(self, now_ns: int, until_ns: int) -> None:
        """Record that the channel is busy from `now_ns` to `until_ns`, for a station that has nothing to send."""

    def postpone(self, now_ns: int, until_ns: int) -> int:
        """Record that the channel is busy from `now_ns` to `until_ns`, for a station that waits to send.

        Returns:
            The time at which it may start if the channel then stays idle.
        """

    def defer_until(self, until_ns: int) -> None:
        """Count no backoff slots before `until_ns`: the end of EIFS after a frame that the station did not decode."""

    def end_eifs(self) -> None:
        """End EIFS, because a frame was decoded: only the inter-frame space after the end of the frame remains."""

    def set_busy_until(self, until_ns: int) -> None:
        """Record that the channel is busy until `until_ns`."""

    def on_success(self) -> None:
        """Reset the contention window and draw a backoff, after a frame that was delivered or given up."""

    def on_failure(self) -> None:
        """Double the contention window and draw a backoff, after a frame that was not acknowledged."""


class Contention:
    """Carrier sense and backoff of a station with one queue; see `ChannelAccess` for its methods.

    Backoff slots count down only after the channel has been idle for an inter-frame space; the remaining slots
    wait for the next idle period. A new backoff is drawn after every frame, so that no station keeps the channel.

    Args:
        draw: Returns a uniform random number on [0, 1) per call.
        ifs_ns: Inter-frame space before the backoff.
        cw_min: Smallest contention window.
        cw_max: Largest contention window.

    Attributes:
        busy_until_ns: End of the last frame or reservation that the station has sensed or sent.
        count_from_ns: Time from which backoff slots count down.
        slots: Backoff slots that remain.
    """

    __slots__ = ("_cw_max", "_cw_min", "_draw", "_window", "busy_until_ns", "count_from_ns", "ifs_ns", "slots")

    def __init__(self, draw: Callable[[], float], ifs_ns: int, *, cw_min: int = CW_MIN, cw_max: int = CW_MAX) -> None:
        self._draw = draw
        self.ifs_ns = ifs_ns
        self._window = self._cw_min = cw_min
        self._cw_max = cw_max
        self.busy_until_ns = 0
        self.count_from_ns = 0
        self.slots = 0

    def earliest_start_ns(self, now_ns: int) -> int:
        """Count down the slots that were idle until `now_ns`, and return the earliest start time from then on.

        A backoff is drawn if the channel is busy and no slots remain.
        """
        self._count_down(now_ns)
        if now_ns < self.busy_until_ns and not self.slots:
            self._draw_backoff()
        return max(now_ns, self.count_from_ns + self.slots * SLOT_NS)

    def on_busy(self, now_ns: int, until_ns: int) -> None:
        """Record that the channel is busy from `now_ns` to `until_ns`, for a station that has nothing to send."""
        if self.slots:
            self._count_down(now_ns)
        self.set_busy_until(until_ns)

    def postpone(self, now_ns: int, until_ns: int) -> int:
        """Record that the channel is busy from `now_ns` to `until_ns`, for a station that waits to send.

        Returns:
            The time at which it may start if the channel then stays idle.
        """
        if not self.slots:
            self._draw_backoff()
        elif now_ns > self.count_from_ns:
            self._count_down(now_ns)
        # An ACK changes nothing for stations that decoded the data frame, which reserved the time of its ACK.
        if until_ns > self.busy_until_ns or until_ns + self.ifs_ns > self.count_from_ns:
            self.set_busy_until(until_ns)
        # A station that drew 0 slots draws again if the channel is busy, as in `earliest_start_ns`.
        if not self.slots:
            self._draw_backoff()
        return self.count_from_ns + self.slots * SLOT_NS

    def defer_until(self, until_ns: int) -> None:
        """Count no backoff slots before `until_ns`: the end of EIFS after a frame that the station did not decode."""
        self.count_from_ns = max(self.count_from_ns, until_ns)

    def end_eifs(self) -> None:
        """End EIFS, because a frame was decoded: only the inter-frame space after the end of the frame remains."""
        self.count_from_ns = min(self.count_from_ns, self.busy_until_ns + self.ifs_ns)

    def set_busy_until(self, until_ns: int) -> None:
        """Record that the channel is busy until `until_ns`."""
        # This runs for every station in range of every frame; a call of `max` would take longer than all other
        # statements.
        if until_ns > self.busy_until_ns:  # noqa: PLR1730 (see above)
            self.busy_until_ns = until_ns
        if until_ns + self.ifs_ns > self.count_from_ns:  # noqa: PLR1730 (see above)
            self.count_from_ns = until_ns + self.ifs_ns

    def on_success(self) -> None:
        """Reset the contention window and draw a backoff, after a frame that was delivered or given up."""
        self._window = self._cw_min
        self._draw_backoff()

    def on_failure(self) -> None:
        """Double the contention window and draw a backoff, after a frame that was not acknowledged."""
        self._window = min(2 * self._window + 1, self._cw_max)
        self._draw_backoff()

    def _draw_backoff(self) -> None:
        self.slots = int(self._draw() * (self._window + 1))

    def _count_down(self, now_ns: int) -> None:
        """Subtract the slots that were idle until `now_ns`."""
        if self.slots and now_ns > self.count_from_ns:
            idle = min((now_ns - self.count_from_ns) // SLOT_NS, self.slots)
            self.slots -= idle
            self.count_from_ns += idle * SLOT_NS


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

    def schedule(self, at_ns: int, call: Callable[..., None], *arguments: object) -> None:
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
