"""A moving robot, and the operator's order to stop it."""

import threading
import time
from typing import Final, NamedTuple

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError
from fieldkit.motion import halting
from fieldkit.motion.halting import Halted
from fieldkit.remote.motion_states import DESCENDING_STATES, STATE_TEXTS
from fieldkit.remote.shell import Shell
from fieldkit.steps.motions import Report

STOPPED_BY: Final = "the-operator"
"""Recorded on a robot as the originator of the stop."""

_REPLY_S: Final = 3.0
"""After this time without an answer a robot is reported as out of reach; a control connection answers in 0.1 s."""
_POLL_S: Final = 0.5
_LANDING_S: Final = 600.0
"""Maximum wait for a landing; the pilot waits equally long (`fieldkit.agent.flying.landing`)."""


class RobotMover(NamedTuple):
    """A robot that a program of fieldkit moves; a `fieldkit.steps.motions.Mover`.

    Attributes:
        robot: Its name.
        shell: Its control connection.
        folder: The folder of the attempt on it.
        fallback: Text on what the robot does if no order reaches it: "it stops automatically within 2 s".
    """

    robot: str
    shell: Shell
    folder: str
    fallback: str

    def stop(self, report: Report, abandoned: threading.Event) -> None:
        """Stop the robot, and wait until it is stationary or on the ground."""
        start_s = time.monotonic()
        try:
            halted = halting.halt_attempt(self.shell, self.folder, STOPPED_BY, Deadline.after(_REPLY_S))
            report(self._report_line(halted, start_s))
            while halted.state in DESCENDING_STATES and time.monotonic() < start_s + _LANDING_S:
                if abandoned.wait(_POLL_S):
                    return
                names = [name for name, _ in halted.programs]
                halted = halting.poll_states(self.shell, names, Deadline.after(_REPLY_S))
                if halted.state not in DESCENDING_STATES:
                    report(self._report_line(halted, start_s))
        except FieldkitError as error:
            report(f"no answer from {self.robot}: {self.fallback} ({error.what})")

    def _report_line(self, halted: Halted, start_s: float) -> str:
        return f"{self.robot}: {STATE_TEXTS[halted.state]}, {time.monotonic() - start_s:.1f} s after the order"
