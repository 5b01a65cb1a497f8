"""A timer of a transport, on a wire whose planned calls cannot be taken back."""

from collections.abc import Callable

from sim_backends.network.wire import Wire


class Alarm:
    """Calls once at the time that was set, which may be moved to earlier, or be cancelled.

    Args:
        wire: Keeps the time.
        call: What is called.

    Attributes:
        at_ns: When it calls; None while it is not set.
    """

    def __init__(self, wire: Wire, call: Callable[[], None]) -> None:
        self._wire = wire
        self._call = call
        self.at_ns: int | None = None

    def no_later_than(self, at_ns: int) -> None:
        """Call at `at_ns`, or before where it was set to earlier already."""
        at_ns = max(at_ns, self._wire.now_ns)
        if self.at_ns is None or at_ns < self.at_ns:
            self.at_ns = at_ns
            self._wire.at(at_ns, self._ring)

    def cancel(self) -> None:
        """Call no more, until it is set again."""
        self.at_ns = None

    def _ring(self) -> None:
        if self.at_ns == self._wire.now_ns:
            self.at_ns = None
            self._call()
