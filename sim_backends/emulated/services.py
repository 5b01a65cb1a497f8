"""The programs that run in an emulated robot from its start to its end."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.deadline import Deadline
from fieldkit.errors import RobotError
from sim_backends.emulated import network, system
from sim_backends.emulated.spec import HOME, ROS_MASTER_PORT, STATE, RobotSpec

SSH_PORT: Final = 22
READY_FOLDER: Final = f"{STATE}/ready"
SENSORS_FILE: Final = f"{STATE}/sensors.json"

_POLL_S: Final = 0.005
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
        Service("sshd", _sshd(spec), {}, lambda: network.listens(SSH_PORT)),
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


def _sshd(spec: RobotSpec) -> tuple[str, ...]:
    options = {
        "HostKey": system.HOST_KEY,
        "PidFile": "none",
        "UsePAM": "no",
        "UseDNS": "no",
        "PasswordAuthentication": "no",
        "KbdInteractiveAuthentication": "no",
        "PermitRootLogin": "prohibit-password",
        "MaxSessions": "64",
        "MaxStartups": "64",
        "PrintLastLog": "no",
        "Subsystem": "sftp internal-sftp",
    }
    words = [word for name, value in options.items() for word in ("-o", f"{name}={value}")]
    listen = [f"ListenAddress={address}:{SSH_PORT}" for address in ("127.0.0.1", spec.ip)]
    words += [word for value in listen for word in ("-o", value)]
    return ("/usr/sbin/sshd", "-D", "-e", "-f", "/dev/null", *words)


class Supervisor:
    """Starts services, knows when one ended, and collects every orphan: the duty of a namespace's first process."""

    def __init__(self) -> None:
        self._running: dict[int, Service] = {}
        self._ended: dict[str, int] = {}

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


def _log(service: Service) -> Path:
    return Path(STATE, f"{service.name}.log")


def _tail(service: Service) -> str:
    lines = _log(service).read_text(encoding="utf-8", errors="replace").splitlines()
    return " / ".join(lines[-_LOG_TAIL:]) or "its log is empty"
