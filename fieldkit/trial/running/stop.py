"""Stop a running trial, from a signal handler or another thread."""

from collections.abc import Iterator
from contextlib import contextmanager


class Stop:
    """One request to stop: taken up between two repeats while one runs, at once otherwise.

    Attributes:
        asked: Whether the trial is to stop after the repeat that runs.
        patient: Whether a repeat runs that may be finished first.
        saving: Whether something is being written that must not be left half done.
        due: Whether to stop as soon as it is.
    """

    def __init__(self) -> None:
        self.asked = False
        self.patient = False
        self.saving = False
        self.due = False

    @contextmanager
    def finishing(self) -> Iterator[None]:
        """Let the body end before a request to stop is taken up.

        Raises:
            KeyboardInterrupt: The body has ended, and somebody asked meanwhile.
        """
        self.patient = True
        try:
            yield
        finally:
            self.patient = False
        if self.asked:
            raise KeyboardInterrupt

    @contextmanager
    def whole(self) -> Iterator[None]:
        """Let the body end, which takes a moment, before anything stops.

        Raises:
            KeyboardInterrupt: The body has ended, and something was to stop meanwhile.
        """
        self.saving = True
        try:
            yield
        finally:
            self.saving = False
        if self.due:
            raise KeyboardInterrupt
