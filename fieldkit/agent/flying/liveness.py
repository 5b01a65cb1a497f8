"""Liveness of the pilot and the guard of a drone: each sees within 1 s that the other does not run any more.

Both map one file, which is allocated before the flight: a full disk does not look like a program that has ended. Each
has an entry in it: its process, what it does, and a counter that it increments with each turn, ten times a second.
"""

from __future__ import annotations

import mmap
import os
import signal
import struct
import time
from contextlib import suppress
from typing import NamedTuple

PILOT, GUARD = 0, 1
"""Entries of the file."""
IDLE, FLYING, LANDING, ENDED = 0, 1, 2, 3
"""What a program does: waits, leads the drone, brings it down, has ended."""

SILENT_S = 0.8
"""A program whose counter does not change for this time does not run."""
_LOOK_S = 0.2
"""A look counts for at most this time: a delay of the watching program is not one of the program that it watches."""
_ENTRY = struct.Struct("<QQQQ")
SIZE = 2 * _ENTRY.size
"""Of the file, in bytes."""
_SUSPENDED = "Tt"
_ENDED = "ZXx"
"""States of a process in /proc/PID/stat (proc_pid_stat(5))."""


class LifeEntry(NamedTuple):
    """Entry of a program.

    Attributes:
        pid: Its process.
        started: When that started, in clock ticks since boot.
        turns: How many turns it has taken.
        state: What it does.
    """

    pid: int
    started: int
    turns: int
    state: int


def entries(content: bytes) -> tuple[LifeEntry, LifeEntry]:
    """Return the entries of the pilot and of the guard.

    Raises:
        ValueError: This is not the content of such a file.
    """
    if len(content) != SIZE:
        raise ValueError(f"{len(content)} bytes instead of {SIZE}")
    pilot, guard = _ENTRY.iter_unpack(content)
    return LifeEntry(*pilot), LifeEntry(*guard)


class LivenessFile:
    """The file that the pilot and the guard of a drone share.

    Args:
        path: The file; it is made where it is missing.
        own: `PILOT` or `GUARD`: the entry of this program.

    Raises:
        OSError: It cannot be made, or has no room.
    """

    def __init__(self, path: str, own: int) -> None:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, SIZE)
            self._map = mmap.mmap(descriptor, SIZE)
        finally:
            os.close(descriptor)
        self._own = own
        self._count = self._other_count = 0
        self._silent_s, self._looked_s = 0.0, time.monotonic()

    def beat(self, state: int) -> None:
        """Increment the own counter, and write what this program does."""
        self._count += 1
        entry = os.getpid(), _process(os.getpid())[1], self._count, state
        _ENTRY.pack_into(self._map, self._own * _ENTRY.size, *entry)

    @property
    def other_state(self) -> int:
        """What the other program does, or did when it ran last."""
        return self._other().state

    def look(self) -> str:
        """Look at the other program; to be called with each turn.

        Returns:
            How it came that it does not run; empty while it runs.
        """
        pid, started, count, _ = self._other()
        now_s = time.monotonic()
        passed_s, self._looked_s = min(now_s - self._looked_s, _LOOK_S), now_s
        self._silent_s = self._silent_s + passed_s if count == self._other_count else 0.0
        self._other_count = count
        state, other_started = _process(pid)
        if not pid or other_started != started or state in _ENDED:
            return "has ended"
        if state in _SUSPENDED:
            return "is suspended"
        return f"has not run for {self._silent_s:.1f} s" if self._silent_s > SILENT_S else ""

    def end_other(self) -> None:
        """Kill the other program, which must not continue later; not another process that has its number now."""
        pid, started, *_ = self._other()
        if pid and _process(pid)[1] == started:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _other(self) -> LifeEntry:
        return entries(self._map[:])[1 - self._own]


def _process(pid: int) -> tuple[str, int]:
    """Return the state of a process, and when it started in clock ticks since boot; `X`, 0 if it does not exist."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:  # noqa: PTH123 (Python 3.8)
            fields = file.read().rpartition(")")[2].split()
        return fields[0], int(fields[19])
    except (OSError, IndexError, ValueError):
        return "X", 0
