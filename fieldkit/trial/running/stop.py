"""Requests to stop a running trial, from a signal handler or another thread."""

from collections.abc import Iterator
from contextlib import contextmanager

from fieldkit.core.deadline import Deadline
from fieldkit.steps.motions import Motions


class Stop:
    """A request to stop.

    It takes effect immediately while a robot moves without a person or may start to move (`motions`), and while no
    repeat is running. Otherwise, it takes effect after the running repeat.

    Attributes:
        after_repeat: True if the trial must stop after the running repeat.
        can_finish: True if a running repeat may finish before the trial stops.
        saving: True while files are being written that must not be left incomplete.
        after_saving: True if the trial must stop when these files are written.
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
        """Estimated remaining time of the running repeat in seconds; 0 if the repeat takes longer than estimated."""
        return self._expected_end.remaining_s

    @contextmanager
    def finishing(self, expected_s: float, motions: tuple[str, ...]) -> Iterator[None]:
        """Delay a request to stop until the body has finished, unless robots move without a person in the body.

        Args:
            expected_s: Estimated duration of the body, in seconds.
            motions: Value of `Motions.stop_notes`. If it is not empty, a request to stop takes effect immediately
                until the body clears it.

        Raises:
            KeyboardInterrupt: A stop was requested while the body was running.
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
        """Delay a stop until the body, which must be short, has finished.

        Raises:
            KeyboardInterrupt: A stop was due while the body was running.
        """
        self.saving = True
        try:
            yield
        finally:
            self.saving = False
        if self.after_saving:
            raise KeyboardInterrupt
