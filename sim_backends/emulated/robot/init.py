"""The first process of an emulated robot, or of the laptop: PID 1 in its namespaces, which end with it.

It does what the lab asks over the control socket it inherited: one JSON line each way, strictly in turn. When the
lab is gone, the socket reaches its end, this process exits, and the kernel ends everything in the namespaces.
"""

import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from sim_backends.emulated.process import ipc
from sim_backends.emulated.process.ipc import Message
from sim_backends.emulated.robot import babeld, mounts, network, rootfs, services
from sim_backends.emulated.robot.services import Service
from sim_backends.emulated.robot.spec import HOME, STATE, RobotSpec
from sim_backends.emulated.robot.supervisor import Supervisor
from sim_backends.emulated.ros import own_motion
from sim_backends.emulated.ros.neighbours import Neighbourhood
from sim_backends.emulated.ros.own_motion import AssignedPath

START_S: Final = 30.0
"""How long a robot's programs may take to get up; Debian's ROS on a busy machine takes a few seconds."""

_MESSAGE_S: Final = 10.0

VOLATILE: Final = ("/tmp", "/run", "/dev/shm")  # noqa: S108 (the robot's own)
"""Folders that a robot holds in memory; the others lie on its SD card."""


class Init:
    """Serves the lab until it hangs up.

    Args:
        channel: Control socket.
        wake_fd: Readable after a child has ended.
    """

    def __init__(self, channel: socket.socket, wake_fd: int) -> None:
        self._channel = channel
        self._wake_fd = wake_fd
        self._supervisor = Supervisor()
        self._neighbourhood: Neighbourhood | None = None

    def run(self) -> None:
        """Return when the lab has hung up."""
        lab_is_there = True
        while lab_is_there:
            watched = [self._channel.fileno(), self._wake_fd]
            readable, _, _ = select.select(watched, [], [], self._supervisor.restart())
            if self._wake_fd in readable:
                os.read(self._wake_fd, 4096)
                self._supervisor.reap()
            if self._channel.fileno() in readable:
                lab_is_there = self._serve()

    def _serve(self) -> bool:
        received = ipc.receive(self._channel, Deadline.after(_MESSAGE_S))
        if received is None:
            return False
        request, handed = received
        descriptors: list[int] = []
        try:
            descriptors = self._answer(request, handed)
            reply: Message = {}
        except FieldkitError as error:
            reply = {"error": error.what, "remedy": error.remedy}
        except (OSError, subprocess.SubprocessError) as error:
            reply = {"error": f"{request['do']}: {error}", "remedy": ""}
        ipc.send(self._channel, reply, Deadline.after(_MESSAGE_S), descriptors)
        for fd in (*handed, *descriptors):
            os.close(fd)
        return True

    def _answer(self, request: Message, handed: Sequence[int]) -> list[int]:
        """Do what `request` asks, with the descriptors that came with it; return those to hand over."""
        match request["do"]:
            case "build":
                spec = RobotSpec.from_json(request["robot"])
                _build(spec)
                # The sensors process is a fork of this one: it inherits the memory, and no descriptor.
                self._neighbourhood = Neighbourhood(handed[0], len(spec.hosts)) if handed else None
                return [os.open(services.STEERED, os.O_RDONLY | os.O_CREAT, 0o600)]
            case "open radio":
                return [_open_radio(request)]
            case "start":
                self._start(RobotSpec.from_json(request["robot"]))
            case "switch off" | "switch on" as what:
                switch = network.switch_on if what == "switch on" else network.switch_off
                switch(request["interface"])
            case "move":
                own_motion.append_path(services.MOTION, AssignedPath(**request["way"]))
            case "kill":
                kill_processes(request["process"])
            case "halt":
                self._halt(request["interface"])
            case "boot":
                network.switch_on(request["interface"])
                self._spawn(RobotSpec.from_json(request["robot"]))
            case "socket":
                return [socket.socket(socket.AF_INET, socket.SOCK_STREAM).detach()]
            case other:
                raise FieldkitError(f"unknown request {other!r}")
        return []

    def _start(self, spec: RobotSpec) -> None:
        deadline = Deadline.after(START_S)
        for service in self._spawn(spec):
            self._supervisor.wait_ready(service, deadline)

    def _halt(self, interface: str) -> None:
        # Off the air first: a robot without power says no goodbye to its peers.
        network.switch_off(interface)
        self._supervisor.halt()
        lose_memory()

    def _spawn(self, spec: RobotSpec) -> list[Service]:
        """Start the robot's services without waiting for them: requests are served strictly in turn."""
        Path(services.READY_FOLDER).mkdir(exist_ok=True)
        found = services.services(spec, self._neighbourhood)
        for service in found:
            self._supervisor.start(service)
        return found


def _open_radio(request: Message) -> int:
    """Bring up the radio interface, and what a guest of a mesh routes with; return the device's descriptor."""
    interface, address, hello_s = request["interface"], request["address"], request["guest_hello_s"]
    fd = network.bring_up(interface, address, mesh=request["mesh"])
    if hello_s is not None:
        services.spawn(babeld.guest_command(interface, address, hello_s), {}, Path(os.devnull))
    return fd


def _build(spec: RobotSpec) -> None:
    socket.sethostname(spec.name)
    mounts.isolate(replaced=spec.setup)
    rootfs.furnish(spec)
    os.chdir(HOME)


def _reset_signals() -> None:
    """Undo what this process inherited, so that nothing in the robot ignores or blocks a signal."""
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, [])


def _wake_on_children() -> int:
    """Return a descriptor that is readable after a child has ended."""
    wake_fd, signal_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(signal_fd, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
    return wake_fd


def kill_processes(process: str) -> None:
    """End every process of the robot that has this name, but the first one, without warning.

    Raises:
        RobotError: There is none.
    """
    found = [pid for pid in _pids() if pid != os.getpid() and _process_name(pid) == process]
    if not found:
        raise RobotError(f"no process named {process} runs", remedy="on the robot: cat /proc/[0-9]*/comm | sort -u")
    for pid in found:
        os.kill(pid, signal.SIGKILL)


def lose_memory() -> None:
    """Lose what a robot loses with its power: what lies in memory, and the name of this boot."""
    for folder in VOLATILE:
        mounts.clear(Path(folder), keep=(STATE, rootfs.SSHD_FOLDER))
    mounts.clear(Path(services.READY_FOLDER))
    rootfs.new_boot_id()


def _pids() -> list[int]:
    return [int(path.name) for path in Path("/proc").glob("[0-9]*")]


def _process_name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").rstrip("\n")
    except OSError:
        return ""  # it ended meanwhile


def main() -> None:
    """Be PID 1, on the control socket whose number the command line gives."""
    os.umask(0o022)
    _reset_signals()
    Init(socket.socket(fileno=int(sys.argv[1])), _wake_on_children()).run()


if __name__ == "__main__":
    main()
