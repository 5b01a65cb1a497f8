"""Init process of an emulated robot, or of the laptop: PID 1 in its namespaces, with the supervisor of its services.

It executes the lab's requests from the control socket that it inherits: one JSON line per request and one per reply,
in strict alternation. When the lab exits, the socket reaches end-of-file, this process exits, and the kernel kills
all processes in the namespaces.
"""

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from sim_backends.emulated.process import worker
from sim_backends.emulated.process.worker import Message
from sim_backends.emulated.robot import mounts, network, rootfs, services
from sim_backends.emulated.robot.services import Service
from sim_backends.emulated.robot.spec import HOME, LOOPBACK_INTERFACE, START_S, STATE, RobotSpec, WifiSpec
from sim_backends.emulated.robot.velocity_command import VELOCITY_COMMAND
from sim_backends.emulated.ros.assigned_path import AssignedPath, append_path
from sim_backends.emulated.ros.lab_positions import Neighbourhood

RESTART_S: Final = 0.1
"""Delay before a service that exited is restarted; the default of systemd's RestartSec."""

_POLL_S: Final = 0.005
_HALT_S: Final = 5.0
"""Timeout until all killed processes have exited."""
_LOG_TAIL_LINES: Final = 3


class Supervisor:
    """Starts services, restarts them when they exit, and reaps all children, including orphans."""

    def __init__(self) -> None:
        self._running: dict[int, Service] = {}
        self._exit_codes: dict[str, int] = {}
        self._restarts: list[tuple[float, Service]] = []

    def start(self, service: Service) -> None:
        """Start a service.

        Raises:
            OSError: The program is missing.
        """
        self._running[service.launch(_log(service))] = service

    def wait_ready(self, service: Service, deadline: Deadline) -> None:
        """Return when a service is ready.

        Raises:
            RobotError: It exited, or was not ready by the deadline; the message contains the end of its log.
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
                self._restarts.append((time.monotonic() + RESTART_S, service))

    def restart(self) -> float | None:
        """Restart each service that is due; return the seconds until the next one is due, or None.

        Raises:
            OSError: The program is missing.
        """
        while self._restarts and self._restarts[0][0] <= time.monotonic():
            self.start(self._restarts.pop(0)[1])
        return max(0.0, self._restarts[0][0] - time.monotonic()) if self._restarts else None

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
        self._restarts.clear()


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
    return " / ".join(lines[-_LOG_TAIL_LINES:]) or "its log is empty"


_MESSAGE_S: Final = 10.0
"""Timeout of a message from or to the lab."""

VOLATILE: Final = ("/tmp", "/run", "/dev/shm")  # noqa: S108 (in the robot)
"""Folders whose content is in the robot's memory, and is lost without power; other folders are on its SD card."""


class Init:
    """Serves the lab until it closes the control socket.

    Args:
        channel: Control socket.
        wake_fd: Descriptor that is readable after a child has exited.
    """

    def __init__(self, channel: socket.socket, wake_fd: int) -> None:
        self._channel = channel
        self._wake_fd = wake_fd
        self._supervisor = Supervisor()
        self._neighbourhood: Neighbourhood | None = None
        self._wifi: WifiSpec | None = None
        self._interface = ""

    def run(self) -> None:
        """Serve requests; return when the lab has closed the control socket."""
        is_connected = True
        while is_connected:
            descriptors = [self._channel.fileno(), self._wake_fd]
            readable, _, _ = select.select(descriptors, [], [], self._supervisor.restart())
            if self._wake_fd in readable:
                os.read(self._wake_fd, 4096)
                self._supervisor.reap()
            if self._channel.fileno() in readable:
                is_connected = self._serve()
        # While the interface is up, the driver mac80211_hwsim stores frames whose transmission has no result yet, and
        # these prevent the kernel from removing this network namespace.
        if self._wifi is not None:
            network.switch_off(self._interface)

    def _serve(self) -> bool:
        """Execute one request and send the reply; return False if the lab has closed the socket."""
        message = worker.receive(self._channel, Deadline.after(_MESSAGE_S))
        if message is None:
            return False
        request, received_fds = message
        descriptors: list[int] = []
        try:
            descriptors = self._answer(request, received_fds)
            reply: Message = {}
        except FieldkitError as error:
            reply = {"error": error.what, "remedy": error.remedy}
        except (OSError, subprocess.SubprocessError) as error:
            reply = {"error": f"{request['do']}: {error}", "remedy": ""}
        worker.send(self._channel, reply, Deadline.after(_MESSAGE_S), descriptors)
        for fd in (*received_fds, *descriptors):
            os.close(fd)
        return True

    def _answer(self, request: Message, received_fds: Sequence[int]) -> list[int]:
        """Execute `request` with its descriptors; return the descriptors for the reply."""
        match request["do"]:
            case "build":
                spec = RobotSpec.from_json(request["robot"])
                _build(spec)
                # The sensors process is forked from this one: it inherits the mapping, but no descriptor.
                self._neighbourhood = Neighbourhood(received_fds[0], len(spec.hosts)) if received_fds else None
                return _motion_files(spec)
            case "open radio" | "open link":
                return _open_devices(request)
            case "start":
                self._start(RobotSpec.from_json(request["robot"]))
            case "open wifi" | "switch off" | "switch on" | "switch link on":
                self._change_radio(request)
            case "move":
                append_path(services.ASSIGNED_PATHS, AssignedPath(**request["path"]))
            case "kill":
                kill_processes(request["process"])
            case "halt":
                self._halt(request["interfaces"])
            case "boot":
                self._boot(request["interfaces"], RobotSpec.from_json(request["robot"]))
            case "socket":
                return [socket.socket(socket.AF_INET, socket.SOCK_STREAM).detach()]
            case other:
                raise FieldkitError(f"unknown request {other!r}")
        return []

    def _start(self, spec: RobotSpec) -> None:
        deadline = Deadline.after(START_S)
        for service in self._spawn(spec):
            self._supervisor.wait_ready(service, deadline)

    def _halt(self, interfaces: Sequence[str]) -> None:
        # The robot's links are switched off first, because a robot that loses power does not close its connections.
        for interface in interfaces:
            network.switch_off(interface)
        self._supervisor.halt()
        discard_memory()

    def _boot(self, interfaces: Sequence[str], spec: RobotSpec) -> None:
        radio, *links = interfaces
        self._switch_on(radio)
        for interface in links:
            network.switch_on_link(interface)
        self._spawn(spec)

    def _change_radio(self, request: Message) -> None:
        """Execute a request that changes a network interface."""
        match request["do"]:
            case "open wifi":
                from sim_backends.emulated.robot import wireless  # noqa: PLC0415 (only some labs use it)

                wifi, interface = WifiSpec(**request["wifi"]), request["interface"]
                self._wifi, self._interface = wifi, wifi.radio_interface(interface)
                wireless.bring_up(request["device"], interface, request["address"], wifi)
            case "switch off":
                network.switch_off(request["interface"])
            case "switch on":
                self._switch_on(request["interface"])
            case "switch link on":
                network.switch_on_link(request["interface"])

    def _switch_on(self, interface: str) -> None:
        if self._wifi is None:
            network.switch_on(interface)
        else:
            from sim_backends.emulated.robot import wireless  # noqa: PLC0415 (only some labs use it)

            wireless.switch_on(interface, self._wifi)

    def _spawn(self, spec: RobotSpec) -> list[Service]:
        """Start the robot's services without waiting for them, because requests are served one at a time."""
        Path(services.READY_FOLDER).mkdir(exist_ok=True)
        robot_services = services.services(spec, self._neighbourhood)
        for service in robot_services:
            self._supervisor.start(service)
        return robot_services


def _open_devices(request: Message) -> list[int]:
    """Bring up a link and return the descriptor of its device, if it has one.

    If the request has a `guest_hello_s`, also start the routing daemon of a node that uses the robots' mesh routes
    but forwards no packets, such as the laptop.
    """
    interface, address = request["interface"], request["address"]
    if request["do"] == "open link":
        if interface == LOOPBACK_INTERFACE:
            network.add_loopback_address(address)
            return []
        return [network.add_link(interface, address, mesh=request["mesh"])]
    fd, hello_s = network.bring_up(interface, address, mesh=request["mesh"]), request["guest_hello_s"]
    if hello_s is not None:
        services.spawn(network.guest_babeld_command(interface, address, hello_s), {}, Path(os.devnull))
    return [fd]


def _build(spec: RobotSpec) -> None:
    socket.sethostname(spec.name)
    mounts.isolate(replaced_files=spec.setup)
    rootfs.write_files(spec)
    os.chdir(HOME)


def _motion_files(spec: RobotSpec) -> list[int]:
    """Return descriptors of the robot's motion record, and of the files of a physics simulator that moves it."""
    inputs: list[tuple[Path, int]] = []
    if spec.simulated_flight:
        inputs = [(services.FLIGHT_COMMAND, os.O_RDONLY), (services.FLIGHT, os.O_RDWR)]
    elif spec.base is not None and spec.base.is_simulated:
        inputs = [(VELOCITY_COMMAND, os.O_RDONLY)]
    if not inputs:
        return [os.open(services.MOTION_RECORD, os.O_RDONLY | os.O_CREAT, 0o600)]
    files = [(services.MOTION_RECORD, os.O_RDWR), (services.ASSIGNED_PATHS, os.O_RDONLY), *inputs]
    return [os.open(path, flags | os.O_CREAT, 0o600) for path, flags in files]


def _reset_signals() -> None:
    """Restore default signal handling, so that no program of the robot ignores or blocks a signal."""
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])


def _wake_on_children() -> int:
    """Return a descriptor that is readable after a child has exited."""
    wake_fd, signal_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(signal_fd, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
    return wake_fd


def kill_processes(process: str) -> None:
    """Kill every process of the robot that has this name, except init.

    Raises:
        RobotError: There is no such process.
    """
    pids = [pid for pid in _pids() if pid != os.getpid() and _process_name(pid) == process]
    if not pids:
        raise RobotError(
            f"no process named {process} is running", remedy="on the robot: cat /proc/[0-9]*/comm | sort -u"
        )
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):  # it has exited in the meantime
            os.kill(pid, signal.SIGKILL)


def discard_memory() -> None:
    """Discard the state that a robot loses with its power: the content of its memory, and its boot id."""
    for folder in VOLATILE:
        mounts.clear(Path(folder), keep=(STATE, rootfs.SSHD_FOLDER))
    mounts.clear(Path(services.READY_FOLDER))
    rootfs.replace_boot_id()


def _pids() -> list[int]:
    return [int(path.name) for path in Path("/proc").glob("[0-9]*")]


def _process_name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").rstrip("\n")
    except OSError:
        return ""  # the process has exited


def main() -> None:
    """Run as PID 1 on the control socket whose descriptor number is on the command line."""
    os.umask(0o022)
    _reset_signals()
    Init(socket.socket(fileno=int(sys.argv[1])), _wake_on_children()).run()


if __name__ == "__main__":
    main()
