"""Rescue of a drone: the laptop lands it if its pilot and its guard have both exited or are suspended.

The pilot is the program that flies the drone, the guard is the program that lands it if the pilot fails. They run on
the drone and monitor each other. The rescue monitors both by the counters in the file that they share. It polls
several times a second, so it is used only if the control connection does not cross the radio under test.
"""

import threading
from collections.abc import Callable
from typing import Final, Self

from fieldkit.agent.flying.liveness import FLYING, GUARD, LANDING, PILOT, SIZE, entries
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError
from fieldkit.core.text import shorten
from fieldkit.motion import halting
from fieldkit.remote import jobs
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell

MANUAL_ACTION: Final = "TAKE IT OVER BY REMOTE CONTROL, OR COMMAND LAND OR RTL AT THE GROUND STATION"

SILENCE_TIMEOUT_S: Final = 0.6
"""If the counters do not change for this time by the robot's clock, neither program runs: a running program
increments its counter ten times a second."""
_POLL_S: Final = 0.15
_MAX_STEP_S: Final = 0.4
"""Maximum time that one poll adds to the silence. If the whole robot was suspended, two polls are far apart although
the programs still run."""


class LivenessMonitor:
    """Detects from the counters of a pilot and its guard that neither of them runs."""

    def __init__(self) -> None:
        self._iterations: tuple[int, int] | None = None
        self._polled_s = self._silent_s = 0.0

    def update(self, sample: bytes) -> bool:
        """Evaluate a sample; return True if a drone is in flight and neither program runs.

        Args:
            sample: The liveness file followed by /proc/uptime; other data is ignored.
        """
        try:
            programs = entries(sample[:SIZE])
            now_s = float(sample[SIZE:].split()[0])
        except (ValueError, IndexError):
            return False
        iterations = programs[PILOT].iterations, programs[GUARD].iterations
        elapsed_s, self._polled_s = min(now_s - self._polled_s, _MAX_STEP_S), now_s
        self._silent_s = self._silent_s + elapsed_s if iterations == self._iterations else 0.0
        self._iterations = iterations
        is_flying = programs[PILOT].state in {FLYING, LANDING} or programs[GUARD].state == LANDING
        return is_flying and self._silent_s >= SILENCE_TIMEOUT_S


class FlightRescue:
    """Monitors the pilot and the guard of a drone in flight, and starts the rescue once; use as a context manager.

    Args:
        shell: Connection to the robot.
        job: The job of the rescue.
        liveness: The file that pilot and guard share, in the folder of the job.
        alarm: Called with the alarm, from another thread.
        may_send: Whether the control connection may be used during the flight; otherwise nothing is monitored.

    Attributes:
        job: The job of the rescue.
        failure: The reason why the rescue could not be started; empty otherwise.
    """

    def __init__(
        self, shell: Shell, job: Job, liveness: str, alarm: Callable[[str], None], *, may_send: bool
    ) -> None:
        self.job = job
        self.failure = ""
        self._shell = shell
        self._file = f"{job.folder}/{liveness}"
        self._alarm = alarm
        self._may_send = may_send
        self._exit_event = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="rescue", daemon=True)

    def __enter__(self) -> Self:
        if self._may_send:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit_event.set()
        if self._may_send:
            self._thread.join()

    @property
    def may_land(self) -> bool:
        """Whether the rescue can still land the drone: it monitors the programs, or has started the job."""
        return self._may_send and not self.failure

    def _watch(self) -> None:
        """Poll the counters until this context is left; start the rescue if neither program runs."""
        monitor = LivenessMonitor()
        while not self._exit_event.wait(_POLL_S):
            try:
                sample = halting.read_liveness(self._shell, self._file, Deadline.after(jobs.REPLY_S))
            except FieldkitError:  # the link may be restored
                continue
            if monitor.update(sample):
                self._start()
                return

    def _start(self) -> None:
        """Start the rescue. The alarm is sent from a thread, so that a blocked terminal does not delay the rescue."""
        robot = self._shell.robot
        message = f"ALARM: THE PILOT AND THE GUARD OF {robot} DO NOT RUN. FIELDKIT LANDS IT. IF IT DOES NOT DESCEND: "
        alarm = threading.Thread(target=self._alarm, args=(message + MANUAL_ACTION,), name="alarm", daemon=True)
        alarm.start()
        try:
            jobs.start(self._shell, self.job)
        except FieldkitError as error:
            self.failure = shorten(error.what)
            self._alarm(f"ALARM: THE RESCUE OF {robot} DID NOT START: {self.failure}. {MANUAL_ACTION}")
