"""Processes, interfaces and mounts of a test's own, and the error that says some of them stayed."""

import ctypes
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ENDED = ("Z", "X")
"""States in /proc of a process that has ended: it waits to be reaped, or is being reaped."""

# linux/sched.h
_NAMESPACES: Final = {"net": 0x40000000, "mnt": 0x00020000}
_CLONE_FS: Final = 0x00000200
_LIBC: Final = ctypes.CDLL(None, use_errno=True)


class LeakError(AssertionError):
    """Something of a test's own outlived it. A test that fails by this gets no second try."""


@dataclass(frozen=True)
class HostState:
    """Interfaces, addresses, routes and mounts of a namespace; a named network namespace is a mount."""

    links: str
    addresses: str
    routes: str
    mounts: str


def host_state() -> HostState:
    """Return the state of network and mounts where the calling thread is, counters left out."""

    def ip(*words: str) -> str:
        return subprocess.run(("ip", *words), capture_output=True, text=True, check=True).stdout

    return HostState(
        links=ip("-br", "link"),
        addresses=ip("-br", "address"),
        routes=ip("route"),
        mounts=Path("/proc/thread-self/mounts").read_text(encoding="utf-8"),
    )


@contextmanager
def namespaces_of_our_own() -> Iterator[None]:
    """Give the calling thread, and what it starts, a network with loopback alone and mounts of its own.

    Nobody else on the machine puts anything there, so all that stays there is ours.
    """
    folder = os.open(".", os.O_PATH)
    outside = {kind: os.open(f"/proc/thread-self/ns/{kind}", os.O_RDONLY) for kind in _NAMESPACES}
    try:
        _checked(_LIBC.unshare(sum(_NAMESPACES.values())))
        subprocess.run(("mount", "--make-rprivate", "/"), check=True)
        # A name that its owner deletes while we look would go from here too.
        for line in Path("/proc/thread-self/mounts").read_text(encoding="utf-8").splitlines():
            if line.split()[2] == "nsfs":
                subprocess.run(("umount", "--lazy", line.split()[1]), check=True)
        subprocess.run(("ip", "link", "set", "lo", "up"), check=True)
        yield
    finally:
        # A thread that was joined may not have gone yet; who shares a working folder cannot change mounts (setns(2)).
        _checked(_LIBC.unshare(_CLONE_FS))
        for kind, handle in outside.items():
            _checked(_LIBC.setns(handle, _NAMESPACES[kind]))
            os.close(handle)
        os.fchdir(folder)
        os.close(folder)


def _checked(result: int) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


class Untouched:
    """Compares the namespaces of a test with what they were when it began."""

    def __init__(self) -> None:
        self._before = host_state()

    def __call__(self) -> None:
        """See that nothing was added or taken away.

        Raises:
            LeakError: Something was.
        """
        now = host_state()
        if now == self._before:
            return
        told = [
            f"{name}: {sorted(set(was.splitlines()) ^ set(vars(now)[name].splitlines()))}"
            for name, was in vars(self._before).items()
            if was != vars(now)[name]
        ]
        raise LeakError("; ".join(told))


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
    """Return when none of `pids` runs; with 0 s they must have ended.

    Raises:
        LeakError: One still runs after `within_s`.
    """
    ends = time.monotonic() + within_s
    left = pids
    while left := {pid for pid in left if alive(pid)}:
        if time.monotonic() >= ends:
            raise LeakError(f"still running: {left}")
        time.sleep(0.02)
