"""The programs that run in an emulated robot from its start to its end."""

import contextlib
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.deadline import Deadline
from fieldkit.errors import RobotError
from sim_backends.emulated import network, ssh_server, system
from sim_backends.emulated.spec import HOME, ROS_MASTER_PORT, STATE, RobotSpec

READY_FOLDER: Final = f"{STATE}/ready"
SENSORS_FILE: Final = f"{STATE}/sensors.json"

RESTART_S: Final = 0.1
"""How long a service that ended stays away; systemd's own RestartSec."""

_POLL_S: Final = 0.005
_HALT_S: Final = 5.0
_LOG_TAIL: Final = 3
_RELAY: Final = Path(__file__).with_name("ros_relay.py")


@dataclass(frozen=True)
class Service:
    """A program.

    Attributes:
        name: Of its log in `/run/robot`.
        argv: Its command line.
        environment: Variables beside the robot's own.
        ready: Whether it serves.
    """

    name: str
    argv: tuple[str, ...]
    environment: dict[str, str]
    ready: Callable[[], bool]


def services(spec: RobotSpec) -> list[Service]:
    """Return what runs in the robot that `spec` describes."""
    ours = {"PYTHONPATH": str(system.PROJECT)}
    found = [
        Service("sshd", ssh_server.command(spec), {}, lambda: network.listens(ssh_server.SSH_PORT)),
        Service("sensors", tuple(system.python("sim_backends.emulated.sensors")), ours, ready_file("sensors").exists),
    ]
    if spec.ros == "debian":
        # Python as a script would find it: rospy is made for Debian's own interpreter.
        ros = {
            "ROS_MASTER_URI": f"http://127.0.0.1:{ROS_MASTER_PORT}",
            "ROS_IP": "127.0.0.1",
            "PYTHONPATH": str(system.PROJECT),
        }
        master = ("/usr/bin/rosmaster", "--core", "-p", str(ROS_MASTER_PORT))
        found += [
            Service("rosmaster", master, ros, lambda: network.listens(ROS_MASTER_PORT)),
            Service("ros_relay", ("/usr/bin/python3", "-s", str(_RELAY)), ros, ready_file("ros_relay").exists),
        ]
    return found


def ready_file(name: str) -> Path:
    """Return the file that the service `name` makes when it serves."""
    return Path(READY_FOLDER, name)


def call_me(name: str) -> None:
    """Give this process a name that people find: an interpreter's says nothing."""
    Path("/proc/self/comm").write_text(name, encoding="ascii")


class Supervisor:
    """Starts services, and again when they end; collects every orphan: the duty of a namespace's first process."""

    def __init__(self) -> None:
        self._running: dict[int, Service] = {}
        self._ended: dict[str, int] = {}
        self._due: list[tuple[float, Service]] = []

    def start(self, service: Service) -> None:
        """Start a service in a session of its own, its output in its log.

        Raises:
            OSError: The program is missing.
        """
        own = {name: os.environ[name] for name in ("PATH", "LANG")}
        environment = {**own, "HOME": HOME, **service.environment}
        log_flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        pid = os.posix_spawn(
            service.argv[0],
            service.argv,
            environment,
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, "/dev/null", os.O_RDONLY, 0),
                (os.POSIX_SPAWN_OPEN, 1, str(_log(service)), log_flags, 0o600),
                (os.POSIX_SPAWN_DUP2, 1, 2),
            ],
            setsid=True,
            setsigmask=[],
            setsigdef=[signal.SIGPIPE, signal.SIGXFSZ],  # which Python ignores
        )
        self._running[pid] = service

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
