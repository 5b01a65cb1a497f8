"""The processes of the parties of a motion trial with emulated robots, and signals to these processes."""

import json
import os
import signal
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Final

from tests.helpers.host import descendants, is_running

SLOW_STOPPED_S: Final = 0.2
SLOW_RUNS_S: Final = 0.2
"""A slow process is alternately suspended and running for these times."""


class Party(StrEnum):
    """A party of a motion trial."""

    LAPTOP = "laptop"
    FIELDKIT = "fieldkit"
    LINK = "link"
    AGENT = "agent"
    PILOT = "pilot"
    GUARD = "guard"
    ROUTER = "router"
    SERVER = "server"
    OPERATOR = "operator"


ON_ROBOT: Final = (Party.AGENT, Party.PILOT, Party.GUARD, Party.ROUTER, Party.SERVER)


def command_line(pid: int) -> list[str]:
    """The command line of a process; empty if the process has exited."""
    with suppress(OSError):
        return [os.fsdecode(argument) for argument in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[:-1]]
    return []


def agents_on(robot_pid: int) -> dict[int, list[str]]:
    """The command and arguments of each program of fieldkit that runs on a robot, by process id.

    Args:
        robot_pid: The outermost process of the robot, the ancestor of all its processes.
    """
    agents = {}
    for pid in descendants(robot_pid):
        argv = command_line(pid)
        if not argv or not argv[0].rpartition("/")[2].startswith("python") or not is_running(pid):
            continue
        index = next((number for number, argument in enumerate(argv[:3]) if _is_agent(argument)), None)
        if index is not None:
            agents[pid] = argv[index + 1 :]
    return agents


def _is_agent(argument: str) -> bool:
    name = argument.rpartition("/")[2]
    return argument == "fieldkit.agent" or (name.startswith("agent-") and name.endswith(".pyz"))


def pids_of(party: Party, robot_pid: int, router: Callable[[], Iterable[int]] = tuple) -> set[int]:
    """The processes of a party that runs on a robot.

    Args:
        party: A party in `ON_ROBOT`.
        robot_pid: As in `agents_on`.
        router: Returns the processes of the router, if the robot has one.
    """
    if party is Party.ROUTER:
        return set(router())
    agents = agents_on(robot_pid)
    return {pid for pid, argv in agents.items() if argv and _party(argv) is party}


def _party(argv: list[str]) -> Party | None:
    """The party of a program of fieldkit on a robot, from its command and its plan."""
    verb = argv[0]
    if verb == "drive":
        return Party.AGENT
    if verb == "link":
        return Party.SERVER
    if verb == "guard":
        return Party.GUARD
    if verb == "fly" and len(argv) > 1:
        plan = json.loads(argv[1])
        return Party.GUARD if plan.get("guards") or not plan.get("height_m") else Party.PILOT
    return None


def send(signal_number: signal.Signals, pids: Iterable[int]) -> None:
    """Send a signal to processes that have not exited."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal_number)


class SlowProcesses:
    """Suspends processes periodically for `SLOW_STOPPED_S` until `end` is called.

    Args:
        pids: The processes.
    """

    def __init__(self, pids: Iterable[int]) -> None:
        self._pids = set(pids)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="slow processes", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Let the processes continue."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.is_set():
            send(signal.SIGSTOP, self._pids)
            self._stopping.wait(SLOW_STOPPED_S)
            send(signal.SIGCONT, self._pids)
            self._stopping.wait(SLOW_RUNS_S)
