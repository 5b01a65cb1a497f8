"""Processes, interfaces and mounts of a test, and the error for those that remain after the test."""

import ctypes
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

EXITED_STATES = ("Z", "X")
"""Process states in /proc that mean exited: zombie and dead."""

# linux/sched.h
_NAMESPACES: Final = {"net": 0x40000000, "mnt": 0x00020000}
_CLONE_FS: Final = 0x00000200
_LIBC: Final = ctypes.CDLL(None, use_errno=True)


class LeakError(AssertionError):
    """A resource of a test still exists after the test. A test that fails with this error gets no second try."""


@dataclass(frozen=True)
class HostState:
    """Interfaces, addresses, routes and mounts of a namespace; a named network namespace is a mount."""

    links: str
    addresses: str
    routes: str
    mounts: str


def host_state() -> HostState:
    """The network state and mounts of the calling thread, without counters."""

    def ip(*arguments: str) -> str:
        return subprocess.run(("ip", *arguments), capture_output=True, text=True, check=True).stdout

    return HostState(
        links=ip("-br", "link"),
        addresses=ip("-br", "address"),
        routes=ip("route"),
        mounts=Path("/proc/thread-self/mounts").read_text(encoding="utf-8"),
    )


@contextmanager
def separate_namespaces() -> Iterator[None]:
    """Run the calling thread and its children with a separate network that has only loopback, and separate mounts.

    No other process changes these namespaces, so everything that remains there is a leak of the test.
    """
    folder = os.open(".", os.O_PATH)
    original = {kind: os.open(f"/proc/thread-self/ns/{kind}", os.O_RDONLY) for kind in _NAMESPACES}
    try:
        _checked(_LIBC.unshare(sum(_NAMESPACES.values())))
        subprocess.run(("mount", "--make-rprivate", "/"), check=True)
        # A named namespace that its owner deletes during the test would also disappear here.
        for line in Path("/proc/thread-self/mounts").read_text(encoding="utf-8").splitlines():
            if line.split()[2] == "nsfs":
                subprocess.run(("umount", "--lazy", line.split()[1]), check=True)
        subprocess.run(("ip", "link", "set", "lo", "up"), check=True)
        yield
    finally:
        # A joined thread may not have exited yet, and setns(2) forbids changing mounts with a shared working folder.
        _checked(_LIBC.unshare(_CLONE_FS))
        for kind, handle in original.items():
            _checked(_LIBC.setns(handle, _NAMESPACES[kind]))
            os.close(handle)
        os.fchdir(folder)
        os.close(folder)


def _checked(result: int) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


class NamespaceComparison:
    """Compares the namespaces of a test with their initial state."""

    def __init__(self) -> None:
        self._before = host_state()

    def __call__(self) -> None:
        """Check that nothing was added or removed.

        Raises:
            LeakError: The state differs.
        """
        state = host_state()
        if state == self._before:
            return
        differences = [
            f"{name}: {sorted(set(before.splitlines()) ^ set(vars(state)[name].splitlines()))}"
            for name, before in vars(self._before).items()
            if before != vars(state)[name]
        ]
        raise LeakError("; ".join(differences))


def descendants(pid: int) -> set[int]:
    """All direct and indirect child processes of `pid`."""
    children: dict[int, list[int]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:
            continue
        children.setdefault(int(fields[1]), []).append(int(folder.name))
    result: set[int] = set()
    pending = [pid]
    while pending:
        for child in children.get(pending.pop(), []):
            result.add(child)
            pending.append(child)
    return result


def owners(pids: set[int]) -> set[int]:
    """The user ids of `pids`, without processes that have exited."""
    user_ids: set[int] = set()
    for pid in pids:
        with suppress(FileNotFoundError):
            user_ids.add(Path(f"/proc/{pid}").stat().st_uid)
    return user_ids


def process_file(pid: int, name: str) -> bytes:
    """The content of a file of a process in /proc; empty if the process has exited."""
    try:
        return Path("/proc", str(pid), name).read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def is_running(pid: int) -> bool:
    """Return True if a process runs, which is the case until its last thread has exited."""
    process = Path("/proc", str(pid))
    try:
        state = (process / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
        # A main thread that has exited is a zombie until the other threads have exited, too.
        return state not in EXITED_STATES or len(list((process / "task").iterdir())) > 1
    except OSError:
        return False


def wait_for_end(pids: set[int], *, within_s: float) -> None:
    """Wait until none of `pids` runs; with 0 s, they must already have exited.

    Raises:
        LeakError: A process still runs after `within_s`.
    """
    deadline_s = time.monotonic() + within_s
    remaining = pids
    while remaining := {pid for pid in remaining if is_running(pid)}:
        if time.monotonic() >= deadline_s:
            raise LeakError(f"still running: {remaining}")
        time.sleep(0.02)
