"""Stop a running trial, from a signal handler or another thread."""

from collections.abc import Iterator
from contextlib import contextmanager

from fieldkit.core.deadline import Deadline


class Stop:
    """One request to stop: taken up between two repeats while one runs, at once otherwise.

    Attributes:
        asked: Whether the trial is to stop after the repeat that runs.
        patient: Whether a repeat runs that may be finished first.
        saving: Whether something is being written that must not be left half done.
        due: Whether to stop as soon as it is.
        cut_short: In words what robots do that move where the repeat that runs is stopped at once; empty if none is.
    """

    def __init__(self) -> None:
        self.asked = False
        self.patient = False
        self.saving = False
        self.due = False
        self.cut_short = ""
        self._ends = Deadline.after(0.0)

    @property
    def left_s(self) -> float:
        """About how many seconds the repeat that runs takes from now on; 0 where it takes longer than it should."""
        return self._ends.remaining_s

    @contextmanager
    def finishing(self, lasts_s: float, cut_short: str) -> Iterator[None]:
        """Let the body end before a request to stop is taken up.

        Args:
            lasts_s: About how long it takes.
            cut_short: See the class.

        Raises:
            KeyboardInterrupt: The body has ended, and somebody asked meanwhile.
        """
        self._ends, self.cut_short = Deadline.after(lasts_s), cut_short
        self.patient = True
        try:
            yield
        finally:
            self.patient, self.cut_short = False, ""
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
