"""One deadline object, made at the edge and passed down: every wait ends."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

T = TypeVar("T")

_LOOK_S: Final = 0.1
_STOOD_STILL_S: Final = 5.0
"""A wait that took so much longer than it was to: somebody stopped this process for a while, as Ctrl-Z does."""


@dataclass(frozen=True)
class Deadline:
    """A moment on the monotonic clock after which waiting is pointless.

    Attributes:
        at_s: The moment, in seconds of `time.monotonic`.
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
        """Whether the moment has passed."""
        return time.monotonic() >= self.at_s

    def sooner(self, seconds: float) -> "Deadline":
        """Return the earlier of this deadline and `seconds` from now."""
        return Deadline(min(self.at_s, time.monotonic() + seconds))

    def later(self, seconds: float) -> "Deadline":
        """Return the later of this deadline and `seconds` from now."""
        return Deadline(max(self.at_s, time.monotonic() + seconds))

    def after_wait(self, began_s: float, wait_s: float) -> "Deadline":
        """Return the deadline after a wait of `wait_s` at most: later by how long this process stood still in it.

        Its own pause is none of those it waits for, whose answer may be here already.
        """
        still_s = time.monotonic() - began_s - wait_s
        return Deadline(self.at_s + still_s) if still_s > _STOOD_STILL_S else self


class ExpiredError(TimeoutError):
    """A wait met our own deadline; a `TimeoutError` of the system may tell of a dead connection instead.

    Args:
        what: What did not happen, for messages: `start`.
    """


def bounded(call: Callable[[], T], deadline: Deadline, ended: threading.Event, *, what: str = "answer") -> T:
    """Return what `call` returns or raise what it raises; for a wait that knows no time-out, like a name look-up.

    Args:
        call: Runs in a thread of its own, which is left behind when it takes too long.
        deadline: When to give up.
        ended: Set by another thread to give up sooner, which takes 0.1 s.
        what: For the error.

    Raises:
        ExpiredError: The deadline passed, or `ended` was set.
    """
    results: list[T] = []
    errors: list[BaseException] = []
    done = threading.Event()

    def work() -> None:
        try:
            results.append(call())
        except BaseException as error:  # noqa: BLE001 (raised again by the one who waits)
            errors.append(error)
        done.set()

    threading.Thread(target=work, daemon=True).start()
    while not ended.is_set() and not deadline.expired:
        began_s, wait_s = time.monotonic(), min(_LOOK_S, deadline.remaining_s)
        is_done = done.wait(wait_s)
        deadline = deadline.after_wait(began_s, wait_s)
        if is_done:
            for error in errors:
                raise error
            return results[0]
    raise ExpiredError(what)
