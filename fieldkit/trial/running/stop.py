"""Requests to stop a running trial, from a signal handler or another thread."""

from collections.abc import Iterator
from contextlib import contextmanager

from fieldkit.core.deadline import Deadline
from fieldkit.steps.motions import Motions


class Stop:
    """A request to stop.

    The first SIGINT takes effect after the running repeat. A second SIGINT, and SIGTERM and SIGHUP, stop during the
    repeat. While a robot moves automatically or may start to move (`motions`), or no repeat is running, every signal
    takes effect immediately: robots are ordered to stop at once. In all cases KeyboardInterrupt is raised only when
    `saving` is False. `fieldkit.cli.interrupts` implements these rules for signals.

    Attributes:
        after_repeat: True if the trial must stop after the running repeat.
        can_finish: True while a repeat is running, which may finish before the trial stops.
        saving: True while files are being written that must not be left incomplete.
        after_saving: True after a stop that does not wait for the end of the repeat. `saving_files` then raises
            KeyboardInterrupt when its files are complete.
        motions: The robots that move automatically.
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
    def finishing(self, expected_s: float, stop_notes: tuple[str, ...]) -> Iterator[None]:
        """Permit the body, which is a repeat, to finish after a request to stop.

        Args:
            expected_s: Estimated duration of the body, in seconds.
            stop_notes: A line for each robot that moves automatically in the body about its behaviour when it is
                stopped; stored in `Motions.stop_notes`. While there are such lines, a stop does not wait for the end
                of the body. The body deletes them when no robot moves any more.

        Raises:
            KeyboardInterrupt: `after_repeat` was set while the body was running.
        """
        self._expected_end, self.motions.stop_notes = Deadline.after(expected_s), stop_notes
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
            KeyboardInterrupt: A stop is due (`after_saving`), and the body raised no exception.
        """
        self.saving = True
        try:
            yield
        finally:
            self.saving = False
        if self.after_saving:
            raise KeyboardInterrupt
