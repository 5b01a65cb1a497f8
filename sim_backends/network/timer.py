"""A timer that can be moved and stopped, over a wire whose calls cannot."""

from collections.abc import Callable
from functools import partial

from sim_backends.network.wire import Wire


class WireTimer:
    """Calls once at its time, unless it was stopped or set to another before.

    One that is moved later, as by every ACK, plans nothing: the call that is planned already plans the next one.

    Args:
        wire: Whose clock it runs on.
        host: Whose timer it is: while that is off it does not call.
        call: What it calls.

    Attributes:
        due_ns: When it calls; None while it is stopped.
    """

    def __init__(self, wire: Wire, host: str, call: Callable[[], None]) -> None:
        self._wire = wire
        self._host = host
        self._call = call
        self._planned_ns: int | None = None
        self.due_ns: int | None = None

    def set(self, at_ns: int) -> None:
        """Call at `at_ns`, and not when it was to call before."""
        self.due_ns = at_ns
        if self._planned_ns is None or self._planned_ns > at_ns:
            self._plan(at_ns)

    def bring_forward(self, at_ns: int) -> None:
        """Call at `at_ns`, or now if that is past, unless it is to call before."""
        at_ns = max(at_ns, self._wire.now_ns)
        if self.due_ns is None or at_ns < self.due_ns:
            self.set(at_ns)

    def stop(self) -> None:
        """Call no more until it is set again."""
        self.due_ns = None

    def _plan(self, at_ns: int) -> None:
        self._planned_ns = at_ns
        self._wire.at(at_ns, self._host, partial(self._ring, at_ns))

    def _ring(self, planned_ns: int) -> None:
        if planned_ns != self._planned_ns:
            return  # it was moved earlier, and another call is planned
        self._planned_ns = None
        if self.due_ns is None:
            return
        if self.due_ns > self._wire.now_ns:
            self._plan(self.due_ns)
            return
        self.due_ns = None
        self._call()
