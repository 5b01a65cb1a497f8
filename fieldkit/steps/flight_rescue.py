"""The rescue of a drone from the laptop: lands it where its pilot and its guard are both ended or suspended.

The pilot and the guard watch each other. This watches both: their counters in the file that they share. It looks
several times a second, so it is used only where the control connection does not cross the radio under test.
"""

import threading
from collections.abc import Callable
from typing import Final, Self

from fieldkit.agent.flying.liveness import FLYING, GUARD, LANDING, PILOT, SIZE, entries
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError
from fieldkit.core.text import brief
from fieldkit.remote import jobs, motion
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell

MANUAL_ACTION: Final = "TAKE IT OVER BY REMOTE CONTROL, OR COMMAND LAND OR RTL AT THE GROUND STATION"

SILENT_S: Final = 0.6
"""Programs whose counters do not change for this time, by the robot's clock, do not run; they count ten a second."""
_LOOKS_S: Final = 0.15
_MOST_S: Final = 0.4
"""Two looks count for at most this time: a robot that slept meanwhile is not one whose programs do not run."""


class LifeSigns:
    """Counters of a pilot and its guard, from one look to the next."""

    def __init__(self) -> None:
        self._turns: tuple[int, int] | None = None
        self._looked_s = self._silent_s = 0.0

    def take(self, look: bytes) -> bool:
        """Take a look; return whether a drone in flight has neither of them.

        Args:
            look: The file of liveness, then /proc/uptime; anything else is no look.
        """
        try:
            programs = entries(look[:SIZE])
            now_s = float(look[SIZE:].split()[0])
        except (ValueError, IndexError):
            return False
        turns = programs[PILOT].turns, programs[GUARD].turns
        passed_s, self._looked_s = min(now_s - self._looked_s, _MOST_S), now_s
        self._silent_s = self._silent_s + passed_s if turns == self._turns else 0.0
        self._turns = turns
        flies = programs[PILOT].state in {FLYING, LANDING} or programs[GUARD].state == LANDING
        return flies and self._silent_s >= SILENT_S


class FlightRescue:
    """Watches the pilot and the guard of a drone in flight, and starts the rescue once; use as a context manager.

    Args:
        shell: The robot.
        job: The rescue.
        liveness: The file that pilot and guard share, in the folder of the job.
        alarm: Called with the alarm, from another thread.
        sends: Whether the control connection may be used meanwhile; otherwise nothing is watched.

    Attributes:
        job: The rescue.
        failure: Why the rescue could not be started; empty otherwise.
    """

    def __init__(self, shell: Shell, job: Job, liveness: str, alarm: Callable[[str], None], *, sends: bool) -> None:
        self.job = job
        self.failure = ""
        self._shell = shell
        self._file = f"{job.folder}/{liveness}"
        self._alarm = alarm
        self._sends = sends
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="rescue", daemon=True)

    def __enter__(self) -> Self:
        if self._sends:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._left.set()
        if self._sends:
            self._thread.join()

    @property
    def may_land(self) -> bool:
        """Whether it watches, or has started the rescue."""
        return self._sends and not self.failure

    def _watch(self) -> None:
        signs = LifeSigns()
        while not self._left.wait(_LOOKS_S):
            try:
                look = motion.life_signs(self._shell, self._file, Deadline.after(jobs.REPLY_S))
            except FieldkitError:  # the link may come back
                continue
            if signs.take(look):
                self._start()
                return

    def _start(self) -> None:
        """Start the rescue; a terminal that does not take the alarm does not delay it."""
        robot = self._shell.robot
        lost = f"ALARM: THE PILOT AND THE GUARD OF {robot} DO NOT RUN. FIELDKIT LANDS IT. IF IT DOES NOT DESCEND: "
        alarm = threading.Thread(target=self._alarm, args=(lost + MANUAL_ACTION,), name="alarm", daemon=True)
        alarm.start()
        try:
            jobs.start(self._shell, self.job)
        except FieldkitError as error:
            self.failure = brief(error.what)
            self._alarm(f"ALARM: THE RESCUE OF {robot} DID NOT START: {self.failure}. {MANUAL_ACTION}")
