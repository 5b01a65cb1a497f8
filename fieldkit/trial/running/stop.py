"""Stop a running trial, from a signal handler or another thread."""

from collections.abc import Iterator
from contextlib import contextmanager

from fieldkit.core.deadline import Deadline
from fieldkit.steps.motions import Motions


class Stop:
    """One request to stop.

    It is taken up at once while a robot moves by itself or may begin to (`motions`); otherwise between two repeats
    while one runs, and at once while none does.

    Attributes:
        asked: Whether the trial is to stop after the repeat that runs.
        patient: Whether a repeat runs that may be finished first.
        saving: Whether something is being written that must not be left half done.
        due: Whether to stop as soon as it is.
        motions: The robots that move by themselves.
    """

    def __init__(self) -> None:
        self.asked = False
        self.patient = False
        self.saving = False
        self.due = False
        self.motions = Motions()
        self._ends = Deadline.after(0.0)

    @property
    def left_s(self) -> float:
        """About how many seconds the repeat that runs takes from now on; 0 where it takes longer than it should."""
        return self._ends.remaining_s

    @contextmanager
    def finishing(self, lasts_s: float, motions: tuple[str, ...]) -> Iterator[None]:
        """Let the body end before a request to stop is taken up, unless robots move in it by themselves.

        Args:
            lasts_s: About how long it takes.
            motions: See `Motions.ahead`: until the body clears that, a request to stop is taken up at once.

        Raises:
            KeyboardInterrupt: The body has ended, and a stop was requested meanwhile.
        """
        self._ends, self.motions.ahead = Deadline.after(lasts_s), motions
        self.patient = True
        try:
            yield
        finally:
            self.patient, self.motions.ahead = False, ()
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
