"""The supervisor of a robot's services: the duty of its namespace's first process."""

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
"""How long a service that ended stays away; systemd's own RestartSec."""

_POLL_S: Final = 0.005
_HALT_S: Final = 5.0
_LOG_TAIL: Final = 3


class Supervisor:
    """Starts services, and again when they end; collects every orphan."""

    def __init__(self) -> None:
        self._running: dict[int, Service] = {}
        self._ended: dict[str, int] = {}
        self._due: list[tuple[float, Service]] = []

    def start(self, service: Service) -> None:
        """Start a service.

        Raises:
            OSError: The program is missing.
        """
        self._running[service.launch(_log(service))] = service

    def wait_ready(self, service: Service, deadline: Deadline) -> None:
        """Return when a service serves.

        Raises:
            RobotError: It ended, or did not serve by the deadline; the message has the end of its log.
        """
        while not service.ready():
            self.reap()
            if service.name in self._ended:
                raise RobotError(f"{service.name} ended with status {self._ended[service.name]}: {_tail(service)}")
            if deadline.expired:
                raise RobotError(f"{service.name} was not up in time: {_tail(service)}")
            time.sleep(_POLL_S)

    def reap(self) -> None:
        """Collect every child that has ended, the robot's orphans among them."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            service = self._running.pop(pid, None)
            if service is not None:
                self._ended[service.name] = os.waitstatus_to_exitcode(status)
                self._due.append((time.monotonic() + RESTART_S, service))

    def restart(self) -> float | None:
        """Start each service again whose time has come; return in how many seconds the next is due, None if none is.

        Raises:
            OSError: The program is missing.
        """
        while self._due and self._due[0][0] <= time.monotonic():
            self.start(self._due.pop(0)[1])
        return max(0.0, self._due[0][0] - time.monotonic()) if self._due else None

    def halt(self) -> None:
        """End every process of the robot but this one, at once; services stay ended until they are started.

        Raises:
            RobotError: One does not end.
        """
        with contextlib.suppress(ProcessLookupError):  # nobody is there
            os.kill(-1, signal.SIGKILL)
        deadline = Deadline.after(_HALT_S)
        while _has_children():
            self.reap()
            if deadline.expired:
                raise RobotError("a process does not end", remedy="start the lab again")
            time.sleep(_POLL_S)
        self._ended.clear()
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
