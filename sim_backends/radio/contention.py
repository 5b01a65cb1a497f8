"""Contention for the channel: carrier sense, inter-frame space, backoff (IEEE 802.11-2020, 10.3.4, DCF)."""

from collections.abc import Callable
from typing import Final

from sim_backends.radio.modes import CW_MAX, CW_MIN, DIFS_NS, SLOT_NS

BLIND_NS: Final = 4_000
"""What began so little ago is not sensed yet, so that two who begin within it collide: aCCATime, table 17-21."""


class Contention:
    """Carrier sense and backoff of one station.

    Backoff slots count down only while the channel has been idle for an inter-frame space; what is left waits for the
    next idle time. After every frame a new backoff is drawn, so that no station keeps the channel.

    Args:
        draw: Gives uniform numbers on [0, 1), one per call.
    """

    __slots__ = ("_draw", "_window", "busy_until_ns", "count_from_ns", "slots")

    def __init__(self, draw: Callable[[], float]) -> None:
        self._draw = draw
        self._window = CW_MIN
        self.busy_until_ns = 0
        self.count_from_ns = 0
        self.slots = 0

    def wanted(self, now_ns: int) -> int:
        """Return when a station that wants to send at `now_ns` may begin, if the channel stays as it is."""
        self._count(now_ns)
        if now_ns < self.busy_until_ns and not self.slots:
            self._back_off()
        return max(now_ns, self.count_from_ns + self.slots * SLOT_NS)

    def sensed(self, now_ns: int, until_ns: int) -> None:
        """Take it that the channel is busy from `now_ns` to `until_ns` for a station that has nothing to send."""
        if self.slots:
            self._count(now_ns)
        self.sent(until_ns)

    def postponed(self, now_ns: int, until_ns: int) -> int:
        """Take it that the channel is busy from `now_ns` to `until_ns` for a station that waits to send.

        Returns:
            When it may begin, if the channel stays as it is.
        """
        if not self.slots:
            self._back_off()
        elif now_ns > self.count_from_ns:
            self._count(now_ns)
        # An ACK changes nothing for who heard the frame and reserved its time.
        if until_ns > self.busy_until_ns or until_ns + DIFS_NS > self.count_from_ns:
            self.sent(until_ns)
        # Who drew none draws again, as `wanted` has it.
        if not self.slots:
            self._back_off()
        return self.count_from_ns + self.slots * SLOT_NS

    def deferred(self, until_ns: int) -> None:
        """Count no slot before `until_ns`: after a frame that was not decoded, for the time of its ACK (EIFS)."""
        self.count_from_ns = max(self.count_from_ns, until_ns)

    def sent(self, until_ns: int) -> None:
        """Take it that the station itself has the channel until `until_ns`."""
        # Everyone in range is told of every frame; `max` would take longer than all the rest.
        if until_ns > self.busy_until_ns:  # noqa: PLR1730 (see above)
            self.busy_until_ns = until_ns
        if until_ns + DIFS_NS > self.count_from_ns:  # noqa: PLR1730 (see above)
            self.count_from_ns = until_ns + DIFS_NS

    def succeeded(self) -> None:
        """Begin anew after a frame that arrived, or that was given up."""
        self._window = CW_MIN
        self._back_off()

    def failed(self) -> None:
        """Take twice the window after a frame that was not acknowledged."""
        self._window = min(2 * self._window + 1, CW_MAX)
        self._back_off()

    def _back_off(self) -> None:
        self.slots = int(self._draw() * (self._window + 1))

    def _count(self, now_ns: int) -> None:
        """Count down the slots that were idle until `now_ns`."""
        if self.slots and now_ns > self.count_from_ns:
            idle = min((now_ns - self.count_from_ns) // SLOT_NS, self.slots)
            self.slots -= idle
            self.count_from_ns += idle * SLOT_NS
