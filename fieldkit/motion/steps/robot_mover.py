"""A robot that a program of fieldkit moves, and the operator's order to stop it."""

import threading
import time
from typing import Final, NamedTuple

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError
from fieldkit.motion import halting
from fieldkit.motion.halting import HaltResult
from fieldkit.remote.motion_states import DESCENDING_STATES, STATE_TEXTS
from fieldkit.remote.shell import Shell
from fieldkit.steps.motions import Report

STOPPED_BY: Final = "the-operator"
"""Recorded on a robot as the originator of the stop."""

_REPLY_S: Final = 3.0
"""A robot that does not answer for this time is reported as not answering. The usual response time is 0.1 s."""
_POLL_S: Final = 0.5
_LANDING_S: Final = 600.0
"""Maximum wait for a landing; the pilot waits for the same time (`fieldkit.agent.flying.landing`)."""


class RobotMover(NamedTuple):
    """A robot that a program of fieldkit moves; a `fieldkit.steps.motions.Mover`.

    Attributes:
        robot: Name of the robot.
        shell: Control connection to the robot.
        folder: Folder of the attempt on the robot.
        fallback: Behaviour of the robot if no order reaches it, for example "it stops automatically within 2 s".
    """

    robot: str
    shell: Shell
    folder: str
    fallback: str

    def stop(self, report: Report, cancel_event: threading.Event) -> None:
        """Stop the robot, and report its state; if a drone lands, wait for the landing and report the state again.

        The wait ends early after `_LANDING_S`, if `cancel_event` is set, or if the robot does not answer, which is
        reported with `fallback`.
        """
        start_s = time.monotonic()
        try:
            result = halting.halt_attempt(self.shell, self.folder, STOPPED_BY, Deadline.after(_REPLY_S))
            report(self._report_line(result, start_s))
            while result.state in DESCENDING_STATES and time.monotonic() < start_s + _LANDING_S:
                if cancel_event.wait(_POLL_S):
                    return
                names = [name for name, _ in result.programs]
                result = halting.poll_states(self.shell, names, Deadline.after(_REPLY_S))
                if result.state not in DESCENDING_STATES:
                    report(self._report_line(result, start_s))
        except FieldkitError as error:
            report(f"no answer from {self.robot}: {self.fallback} ({error.what})")

    def _report_line(self, result: HaltResult, start_s: float) -> str:
        return f"{self.robot}: {STATE_TEXTS[result.state]}, {time.monotonic() - start_s:.1f} s after the order"
