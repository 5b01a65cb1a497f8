"""A deadline that a caller creates and passes to each function that waits, so that every wait is limited."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

T = TypeVar("T")

_POLL_INTERVAL_S: Final = 0.1  # interval between checks whether a call was cancelled
_MIN_SUSPENDED_S: Final = 5.0
"""A wait that exceeds its timeout by this much means that this process was suspended, for example by Ctrl-Z."""


@dataclass(frozen=True)
class Deadline:
    """A time on the monotonic clock at which a wait must end.

    Attributes:
        at_s: The time, in seconds of `time.monotonic`.
    """

    at_s: float

    @classmethod
    def after(cls, seconds: float) -> "Deadline":
        """Return the deadline `seconds` from now."""
        return cls(time.monotonic() + seconds)

    @property
    def remaining_s(self) -> float:
        """Seconds left, never negative."""
        return max(0.0, self.at_s - time.monotonic())

    @property
    def expired(self) -> bool:
        """Whether the deadline has passed."""
        return time.monotonic() >= self.at_s

    def earlier_of(self, seconds: float) -> "Deadline":
        """Return the earlier of this deadline and `seconds` from now."""
        return Deadline(min(self.at_s, time.monotonic() + seconds))

    def later_of(self, seconds: float) -> "Deadline":
        """Return the later of this deadline and `seconds` from now."""
        return Deadline(max(self.at_s, time.monotonic() + seconds))

    def extended_by_suspension(self, start_s: float, wait_s: float) -> "Deadline":
        """Return the deadline, extended by the time for which this process was suspended during a wait.

        The awaited program has not necessarily failed: its answer may have arrived during the suspension.

        Args:
            start_s: Start of the wait, in seconds of `time.monotonic`.
            wait_s: Time-out of the wait.
        """
        suspended_s = time.monotonic() - start_s - wait_s
        return Deadline(self.at_s + suspended_s) if suspended_s > _MIN_SUSPENDED_S else self


class ExpiredError(TimeoutError):
    """A fieldkit deadline has passed, or a wait was cancelled.

    The operating system raises a plain `TimeoutError` if a connection times out.

    Args:
        what: The action that did not happen in time, for messages: `start`.
    """


def call_with_deadline(
    call: Callable[[], T], deadline: Deadline, cancelled: threading.Event, *, what: str = "answer"
) -> T:
    """Call a function that has no timeout parameter, such as a name look-up; return its result or raise its error.

    Args:
        call: The function. It runs in a daemon thread, which continues if the deadline passes.
        deadline: When to stop waiting.
        cancelled: Another thread sets this event to stop the wait earlier, within 0.1 s.
        what: The awaited action, for the error.

    Raises:
        ExpiredError: The deadline passed, or `cancelled` was set.
    """
    results: list[T] = []
    errors: list[BaseException] = []
    done = threading.Event()

    def work() -> None:
        try:
            results.append(call())
        except BaseException as error:  # noqa: BLE001 (raised again in the waiting thread)
            errors.append(error)
        done.set()

    threading.Thread(target=work, daemon=True).start()
    while not cancelled.is_set() and not deadline.expired:
        start_s, wait_s = time.monotonic(), min(_POLL_INTERVAL_S, deadline.remaining_s)
        is_done = done.wait(wait_s)
        deadline = deadline.extended_by_suspension(start_s, wait_s)
        if is_done:
            for error in errors:
                raise error
            return results[0]
    raise ExpiredError(what)
