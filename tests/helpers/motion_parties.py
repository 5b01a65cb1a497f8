"""Processes of the parties of a motion trial, found on emulated robots, and what is done to them."""

import json
import os
import signal
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Final

from tests.helpers.host import alive, descendants

SLOW_STOPPED_S: Final = 0.2
SLOW_RUNS_S: Final = 0.2
"""A slow process is suspended for the one of these times and runs for the other, in turn."""


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


def words_of(pid: int) -> list[str]:
    """Return the command line of a process; empty where it has ended."""
    with suppress(OSError):
        return [os.fsdecode(word) for word in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[:-1]]
    return []


def agents_on(robot_pid: int) -> dict[int, list[str]]:
    """Return the programs of fieldkit that run on a robot: of each process id, verb and arguments.

    Args:
        robot_pid: The outermost process of the robot; all its processes descend from it.
    """
    found = {}
    for pid in descendants(robot_pid):
        words = words_of(pid)
        if not words or not words[0].rpartition("/")[2].startswith("python") or not alive(pid):
            continue
        at = next((number for number, word in enumerate(words[:3]) if _is_agent(word)), None)
        if at is not None:
            found[pid] = words[at + 1 :]
    return found


def _is_agent(word: str) -> bool:
    name = word.rpartition("/")[2]
    return word == "fieldkit.agent" or (name.startswith("agent-") and name.endswith(".pyz"))


def pids_of(party: Party, robot_pid: int, router: Callable[[], Iterable[int]] = tuple) -> set[int]:
    """Return the processes of a party that runs on a robot.

    Args:
        party: One of `ON_ROBOT`.
        robot_pid: See `agents_on`.
        router: Returns the processes of the router, where there is one.
    """
    if party is Party.ROUTER:
        return set(router())
    agents = agents_on(robot_pid)
    return {pid for pid, words in agents.items() if words and _party(words) is party}


def _party(words: list[str]) -> Party | None:
    """Return the party that a program of fieldkit on a robot is, by its verb and its plan."""
    verb = words[0]
    if verb == "drive":
        return Party.AGENT
    if verb == "link":
        return Party.SERVER
    if verb == "guard":
        return Party.GUARD
    if verb == "fly" and len(words) > 1:
        plan = json.loads(words[1])
        return Party.GUARD if plan.get("guards") or not plan.get("height_m") else Party.PILOT
    return None


def send(number: signal.Signals, pids: Iterable[int]) -> None:
    """Send a signal to processes; one that has ended meanwhile gets none."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)


class SlowProcesses:
    """Suspends processes for `SLOW_STOPPED_S` again and again, until `end`.

    Args:
        pids: The processes.
    """

    def __init__(self, pids: Iterable[int]) -> None:
        self._pids = set(pids)
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._run, name="slow processes", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Let them run."""
        self._left.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._left.is_set():
            send(signal.SIGSTOP, self._pids)
            self._left.wait(SLOW_STOPPED_S)
            send(signal.SIGCONT, self._pids)
            self._left.wait(SLOW_RUNS_S)
