"""Supervisor of a robot's services, part of its init process."""

import contextlib
import os
import signal
import time
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError
from sim_backends.emulated.robot.services import Service
from sim_backends.emulated.robot.spec import STATE

RESTART_S: Final = 0.1
"""Delay before a service that exited is restarted; the default of systemd's RestartSec."""

_POLL_S: Final = 0.005
_HALT_S: Final = 5.0
_LOG_TAIL: Final = 3


class Supervisor:
    """Starts services, restarts them when they exit, and reaps all children, including orphans."""

    def __init__(self) -> None:
        self._running: dict[int, Service] = {}
        self._exit_codes: dict[str, int] = {}
        self._due: list[tuple[float, Service]] = []

    def start(self, service: Service) -> None:
        """Start a service.

        Raises:
            OSError: The program is missing.
        """
        self._running[service.launch(_log(service))] = service

    def wait_ready(self, service: Service, deadline: Deadline) -> None:
        """Return when a service is ready.

        Raises:
            RobotError: It exited, or was not ready by the deadline; the message has the end of its log.
        """
        while not service.ready():
            self.reap()
            if service.name in self._exit_codes:
                raise RobotError(
                    f"{service.name} exited with status {self._exit_codes[service.name]}: {_tail(service)}"
                )
            if deadline.expired:
                raise RobotError(f"{service.name} was not ready in time: {_tail(service)}")
            time.sleep(_POLL_S)

    def reap(self) -> None:
        """Reap every child that has exited, including orphans."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            service = self._running.pop(pid, None)
            if service is not None:
                self._exit_codes[service.name] = os.waitstatus_to_exitcode(status)
                self._due.append((time.monotonic() + RESTART_S, service))

    def restart(self) -> float | None:
        """Restart each service that is due; return the seconds until the next one is due, or None.

        Raises:
            OSError: The program is missing.
        """
        while self._due and self._due[0][0] <= time.monotonic():
            self.start(self._due.pop(0)[1])
        return max(0.0, self._due[0][0] - time.monotonic()) if self._due else None

    def halt(self) -> None:
        """Kill every process of the robot except this one; services are not restarted.

        Raises:
            RobotError: A process does not exit.
        """
        with contextlib.suppress(ProcessLookupError):  # there are no other processes
            os.kill(-1, signal.SIGKILL)
        deadline = Deadline.after(_HALT_S)
        while _has_children():
            self.reap()
            if deadline.expired:
                raise RobotError("a process does not exit", remedy="start the lab again")
            time.sleep(_POLL_S)
        self._exit_codes.clear()
        self._due.clear()


def _has_children() -> bool:
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def _log(service: Service) -> Path:
    return Path(STATE, f"{service.name}.log")


def _tail(service: Service) -> str:
    lines = _log(service).read_text(encoding="utf-8", errors="replace").splitlines()
    return " / ".join(lines[-_LOG_TAIL:]) or "its log is empty"
