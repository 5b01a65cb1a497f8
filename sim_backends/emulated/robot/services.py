"""Services of an emulated robot: how they start, by a program or a fork; which ones there are; their supervisor."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import RobotError
from sim_backends.emulated.process import interpreter
from sim_backends.emulated.robot import network, ssh_server
from sim_backends.emulated.robot.spec import HOME, ROS_MASTER_PORT, STATE, RobotSpec
from sim_backends.emulated.ros import sensors

_LOG_FLAGS: Final = os.O_WRONLY | os.O_CREAT | os.O_APPEND
_LOG_MODE: Final = 0o600

READY_FOLDER: Final = f"{STATE}/ready"

RESTART_S: Final = 0.1
"""How long a service that ended stays away; systemd's own RestartSec."""

_POLL_S: Final = 0.005
_HALT_S: Final = 5.0
_LOG_TAIL: Final = 3
_RELAY: Final = Path(__file__).with_name("ros_relay.py")


def spawn(argv: tuple[str, ...], environment: Mapping[str, str], log: Path) -> int:
    """Start a program in a session of its own, its output in `log`; return its process id.

    Raises:
        OSError: The program is missing.
    """
    return os.posix_spawn(
        argv[0],
        argv,
        environment,
        file_actions=[
            (os.POSIX_SPAWN_OPEN, 0, "/dev/null", os.O_RDONLY, 0),
            (os.POSIX_SPAWN_OPEN, 1, str(log), _LOG_FLAGS, _LOG_MODE),
            (os.POSIX_SPAWN_DUP2, 1, 2),
        ],
        setsid=True,
        setsigmask=[],
        setsigdef=[signal.SIGPIPE, signal.SIGXFSZ],  # which Python ignores
    )


def fork(name: str, work: Callable[[], None], log: Path) -> int:
    """Do `work` in a process of this name and a session of its own, its output in `log`; return its process id.

    It shares the memory of this process, and no descriptor. Call it from a process of one thread.
    """
    pid = os.fork()
    if pid == 0:
        os._exit(_run(name, work, log))
    return pid


def name_process(name: str) -> None:
    """Give this process a name that people find: an interpreter's says nothing."""
    Path("/proc/self/comm").write_text(name, encoding="ascii")


def _run(name: str, work: Callable[[], None], log: Path) -> int:
    try:
        name_process(name)
        _detach(log)
        work()
    except BaseException:  # noqa: BLE001 (whatever it is ends this process, not the one that it was forked from)
        sys.excepthook(*sys.exc_info())
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def _detach(log: Path) -> None:
    """Leave the session, the descriptors and the signal handling of the process that this one was forked from."""
    os.setsid()
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(os.open(log, _LOG_FLAGS, _LOG_MODE), 1)
    os.dup2(1, 2)
    os.closerange(3, os.sysconf("SC_OPEN_MAX"))


@dataclass(frozen=True)
class Service:
    """What runs for as long as the robot does.

    Attributes:
        name: Of its log in `/run/robot`.
        launch: Starts it, its output in that log; returns its process id.
        ready: Whether it serves.
    """

    name: str
    launch: Callable[[Path], int]
    ready: Callable[[], bool]


def services(spec: RobotSpec) -> list[Service]:
    """Return what runs in the robot that `spec` describes."""
    publish = partial(sensors.publish, spec.sensors, spec.definitions, ready=ready_file("sensors"))
    found = [
        _program("sshd", ssh_server.command(spec), {}, lambda: network.listens(ssh_server.SSH_PORT)),
        Service("sensors", partial(fork, "sensors", publish), ready_file("sensors").exists),
    ]
    if spec.ros == "debian":
        # Python as a script would find it: rospy is made for Debian's own interpreter.
        ros = {
            "ROS_MASTER_URI": f"http://127.0.0.1:{ROS_MASTER_PORT}",
            "ROS_IP": "127.0.0.1",
            "PYTHONPATH": str(interpreter.PROJECT),
        }
        master = ("/usr/bin/rosmaster", "--core", "-p", str(ROS_MASTER_PORT))
        relay = ("/usr/bin/python3", "-s", str(_RELAY))
        found += [
            _program("rosmaster", master, ros, lambda: network.listens(ROS_MASTER_PORT)),
            _program("ros_relay", relay, ros, ready_file("ros_relay").exists),
        ]
    return found


def _program(name: str, argv: tuple[str, ...], variables: Mapping[str, str], ready: Callable[[], bool]) -> Service:
    environment = {"PATH": os.environ["PATH"], "LANG": os.environ["LANG"], "HOME": HOME, **variables}
    return Service(name, partial(spawn, argv, environment), ready)


def ready_file(name: str) -> Path:
    """Return the file that the service `name` makes when it serves."""
    return Path(READY_FOLDER, name)


class Supervisor:
    """Starts services, and again when they end; collects every orphan: the duty of a namespace's first process."""

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
