"""Ctrl-C: the first one lets the repeat that runs end, the second one stops it; both save the state."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from fieldkit.trial.stop import Stop

_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_FINISHING: Final = "finishing the repeat that runs; Ctrl-C again stops it now"
_STOPPING: Final = "stopping: ending what runs on the robots"
_CLEAR_LINE: Final = "\r\x1b[K"


@contextmanager
def interruptible() -> Iterator[Stop]:
    """Turn Ctrl-C into a request to stop while the body runs.

    The second one raises `KeyboardInterrupt`, as SIGTERM and SIGHUP do at once: a closed terminal does not wait.
    What comes after that is ignored, since the clean-up that follows is bounded by its own deadlines.
    """
    stop = Stop()
    stopping = False

    def take(number: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        if stopping:
            return
        if number == signal.SIGINT and stop.patient and not stop.asked:
            stop.asked = True
            _say(_FINISHING)
            return
        stopping = True
        _say(_STOPPING)
        stop.due = True
        if not stop.saving:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, take) for number in _SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _say(text: str) -> None:
    """Write past every buffer, over the live line: the signal may have come in the middle of another write."""
    start = _CLEAR_LINE if sys.stderr.isatty() else "\n"
    try:
        os.write(sys.stderr.fileno(), f"{start}{text}\n".encode())
    except OSError:
        return  # the terminal is gone, which may be why we stop
