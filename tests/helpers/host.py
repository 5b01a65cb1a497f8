"""What of this machine a lab must leave as it was."""

import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

ENDED = ("Z", "X")
"""States in /proc of a process that has ended: it waits to be reaped, or is being reaped."""


@dataclass(frozen=True)
class HostState:
    """Interfaces, named namespaces, addresses, routes and mounts of this machine."""

    links: str
    namespaces: str
    addresses: str
    routes: str
    mounts: str


def host_state() -> HostState:
    """Return the state of this machine's network and mounts, counters left out."""

    def ip(*words: str) -> str:
        return subprocess.run(("ip", *words), capture_output=True, text=True, check=True).stdout

    return HostState(
        links=ip("-br", "link"),
        namespaces=ip("netns"),
        addresses=ip("-br", "address"),
        routes=ip("route"),
        mounts=Path("/proc/self/mounts").read_text(encoding="utf-8"),
    )


def descendants(pid: int) -> set[int]:
    """Return the processes that `pid` started, directly or not."""
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:
            continue
        children.setdefault(int(fields[1]), []).append(int(folder.name))
    found: set[int] = set()
    waiting = [pid]
    while waiting:
        for child in children.get(waiting.pop(), []):
            found.add(child)
            waiting.append(child)
    return found


def owners(pids: set[int]) -> set[int]:
    """Return the user ids that run `pids`; who has ended meanwhile has none."""
    found: set[int] = set()
    for pid in pids:
        with suppress(FileNotFoundError):
            found.add(Path(f"/proc/{pid}").stat().st_uid)
    return found


def alive(pid: int) -> bool:
    """Return whether a process runs."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in ENDED


def wait_for_end(pids: set[int], *, within_s: float) -> None:
    """Return when none of `pids` runs.

    Raises:
        AssertionError: One still runs after `within_s`.
    """
    ends = time.monotonic() + within_s
    left = pids
    while left := {pid for pid in left if alive(pid)}:
        assert time.monotonic() < ends, f"still running: {left}"
        time.sleep(0.02)
