"""Stop a running trial, from a signal handler or another thread."""

from collections.abc import Iterator
from contextlib import contextmanager

from fieldkit.core.deadline import Deadline
from fieldkit.steps.motions import Motions


class Stop:
    """A request to stop.

    It takes effect immediately while a robot moves without a person or may start to (`motions`), and while no repeat
    runs; otherwise after the running repeat.

    Attributes:
        after_repeat: Whether the trial must stop after the running repeat.
        can_finish: Whether a repeat is running that may be finished first.
        saving: Whether files are being written that must not be left incomplete.
        after_saving: Whether to stop as soon as they are written.
        motions: The robots that move without a person.
    """

    def __init__(self) -> None:
        self.after_repeat = False
        self.can_finish = False
        self.saving = False
        self.after_saving = False
        self.motions = Motions()
        self._expected_end = Deadline.after(0.0)

    @property
    def left_s(self) -> float:
        """Estimated remaining time of the running repeat in seconds; 0 if it takes longer than estimated."""
        return self._expected_end.remaining_s

    @contextmanager
    def finishing(self, expected_s: float, motions: tuple[str, ...]) -> Iterator[None]:
        """Allow the body to finish before a request to stop takes effect, unless robots move in it without a person.

        Args:
            expected_s: Estimated duration of the body, in seconds.
            motions: See `Motions.stop_notes`: until the body clears it, a request to stop takes effect immediately.

        Raises:
            KeyboardInterrupt: The body has finished, and a stop was requested meanwhile.
        """
        self._expected_end, self.motions.stop_notes = Deadline.after(expected_s), motions
        self.can_finish = True
        try:
            yield
        finally:
            self.can_finish, self.motions.stop_notes = False, ()
        if self.after_repeat:
            raise KeyboardInterrupt

    @contextmanager
    def saving_files(self) -> Iterator[None]:
        """Allow the body, which is short, to finish before a stop.

        Raises:
            KeyboardInterrupt: The body has finished, and a stop was due meanwhile.
        """
        self.saving = True
        try:
            yield
        finally:
            self.saving = False
        if self.after_saving:
            raise KeyboardInterrupt
