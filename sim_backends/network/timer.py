"""A timer that can be rescheduled and stopped, on a wire whose calls cannot be cancelled."""

from collections.abc import Callable
from functools import partial

from sim_backends.network.wire import Wire


class WireTimer:
    """Calls a function once at its due time, unless it is stopped or rescheduled before.

    Postponing the timer, as every ACK does, schedules no further call on the wire: the call that is already scheduled
    schedules the next one when it fires.

    Args:
        wire: The wire that provides the clock.
        host: The host of the timer; the timer does not fire while the host is off.
        call: The function that is called.

    Attributes:
        due_ns: Due time; None while the timer is stopped.
    """

    def __init__(self, wire: Wire, host: str, call: Callable[[], None]) -> None:
        self._wire = wire
        self._host = host
        self._call = call
        self._scheduled_ns: int | None = None
        self.due_ns: int | None = None

    def set(self, at_ns: int) -> None:
        """Set the due time to `at_ns`, replacing an earlier setting."""
        self.due_ns = at_ns
        if self._scheduled_ns is None or self._scheduled_ns > at_ns:
            self._schedule(at_ns)

    def bring_forward(self, at_ns: int) -> None:
        """Set the due time to `at_ns`, or to now if that is past, unless the timer is due earlier."""
        at_ns = max(at_ns, self._wire.now_ns)
        if self.due_ns is None or at_ns < self.due_ns:
            self.set(at_ns)

    def stop(self) -> None:
        """Stop the timer until it is set again."""
        self.due_ns = None

    def _schedule(self, at_ns: int) -> None:
        self._scheduled_ns = at_ns
        self._wire.at(at_ns, self._host, partial(self._fire, at_ns))

    def _fire(self, scheduled_ns: int) -> None:
        if scheduled_ns != self._scheduled_ns:
            return  # the timer was set to an earlier time, for which another call is scheduled
        self._scheduled_ns = None
        if self.due_ns is None:
            return
        if self.due_ns > self._wire.now_ns:
            self._schedule(self.due_ns)
            return
        self.due_ns = None
        self._call()
