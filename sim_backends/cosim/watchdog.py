"""A deadline for answers, and errors that name who failed or did not answer, and what it was asked."""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from fieldkit.core.errors import ConfigurationError, FieldkitError

_AGAIN_S: Final = 0.001
"""When one looks again who finds the limit passed."""


class FederateError(FieldkitError):
    """A party of a co-simulation failed, or answered what cannot be: says who, when, and what it was asked."""


class UnansweredError(FederateError):
    """A party did not answer within its deadline."""

    exit_code = 3


class DeadlinePassed(BaseException):
    """Raised into a party that does not answer; no `except Exception` of its own may take it for its own error.

    Attributes:
        limit_s: For how long nobody answered.
    """

    def __init__(self, limit_s: float) -> None:
        super().__init__(f"no answer for {limit_s:g} s")
        self.limit_s = limit_s


def failed(error: BaseException, who: str, asked: str) -> FederateError:
    """Return the error that names the party which raised `error`, or into which the deadline's end was raised.

    Args:
        error: What came out of it.
        who: The party.
        asked: What it was asked, with the times.
    """
    if isinstance(error, FederateError):
        return error
    if isinstance(error, DeadlinePassed):
        return UnansweredError(
            f"{who} has not answered for {error.limit_s:g} s: asked to {asked}",
            remedy="look at what it waits for, or give it a longer deadline",
        )
    return FederateError(
        f"{who} failed when it was asked to {asked}: {type(error).__name__}: {error}",
        remedy=error.remedy if isinstance(error, FieldkitError) else "",
    )


def seconds(time_ns: int) -> str:
    """Return a simulated time in seconds as text, all digits that it has."""
    whole, rest = divmod(time_ns, 10**9)
    return f"{whole}.{rest:09d}".rstrip("0").rstrip(".") + " s"


@contextmanager
def deadline(limit_s: float | None, asked_s: Callable[[], float]) -> Iterator[None]:
    """Raise `DeadlinePassed` into whoever has been asked for longer than a limit, while the body runs.

    One timer looks, once per limit, so that an exchange costs nothing. It ends every wait of Python; a call of a
    library in C that looks at no signals is ended when it returns. Time in which this process was stopped, as by
    Ctrl-Z, does not count: who is asked has all of the limit from when it goes on.

    Args:
        limit_s: Wall time that an answer may take, in seconds; None for ever.
        asked_s: Tells when somebody was asked last, by `time.perf_counter`.

    Raises:
        ConfigurationError: This is not the main thread: nobody can interrupt another.
    """
    if limit_s is None:
        yield
        return
    if threading.current_thread() is not threading.main_thread():
        raise ConfigurationError(
            f"a deadline of {limit_s:g} s can be kept in the main thread only",
            remedy="run the co-simulation there or in a process of its own, or give it no deadline (None)",
        )

    went_on_s, passed = -math.inf, False

    def go_on(_number: int, _frame: FrameType | None) -> None:
        nonlocal went_on_s
        went_on_s = time.perf_counter()

    def look(_number: int, _frame: FrameType | None) -> None:
        nonlocal passed
        left_s = limit_s - (time.perf_counter() - max(asked_s(), went_on_s))
        if passed and left_s <= 0:
            raise DeadlinePassed(limit_s)
        # Of two signals that came while the process was stopped Python hears of SIGALRM before SIGCONT.
        passed = left_s <= 0
        signal.setitimer(signal.ITIMER_REAL, max(left_s, _AGAIN_S))

    before = {
        number: signal.signal(number, call) for number, call in ((signal.SIGALRM, look), (signal.SIGCONT, go_on))
    }
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, call in before.items():
            signal.signal(number, call)
