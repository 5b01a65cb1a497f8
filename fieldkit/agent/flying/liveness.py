"""Mutual supervision of the pilot and the guard of a drone: each detects within 1 s that the other has stopped.

Both programs map one file, which is allocated before the flight, so that a full disk is not mistaken for a stopped
program. Each program has an entry with its process, its state, and a counter that it increments ten times a second.
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
"""Indices of the entries."""
IDLE, FLYING, LANDING, ENDED = 0, 1, 2, 3
"""State of a program: it waits, flies the drone, lands it, or exits."""

SILENCE_TIMEOUT_S = 0.8
"""A program whose counter does not change for this time is considered stopped."""
_MAX_POLL_S = 0.2
"""Maximum time that one poll adds to the silence, because delays of the polling program must not count."""
_ENTRY = struct.Struct("<QQQQ")
SIZE = 2 * _ENTRY.size
"""Size of the file in bytes."""
_SUSPENDED_STATES = "Tt"
_ENDED_STATES = "ZXx"
"""States of a process in /proc/PID/stat (proc_pid_stat(5))."""


class LifeEntry(NamedTuple):
    """Entry of a program.

    Attributes:
        pid: Its process id.
        start_ticks: Start time of the process, in clock ticks since boot.
        iterations: Counter of its iterations.
        state: Its state: `IDLE`, `FLYING`, `LANDING` or `ENDED`.
    """

    pid: int
    start_ticks: int
    iterations: int
    state: int


def entries(content: bytes) -> tuple[LifeEntry, LifeEntry]:
    """Return the entries of the pilot and of the guard.

    Raises:
        ValueError: The content has a wrong length.
    """
    if len(content) != SIZE:
        raise ValueError(f"{len(content)} bytes instead of {SIZE}")
    pilot, guard = _ENTRY.iter_unpack(content)
    return LifeEntry(*pilot), LifeEntry(*guard)


class LivenessFile:
    """The file that the pilot and the guard of a drone share.

    The *other* program is the guard if this object is used by the pilot, and the pilot if it is used by the guard.

    Args:
        path: The file; it is created if it is missing.
        own_index: Index of the entry of this program: `PILOT` or `GUARD`.

    Raises:
        OSError: The file cannot be created or allocated.
    """

    def __init__(self, path: str, own_index: int) -> None:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, SIZE)
            self._map = mmap.mmap(descriptor, SIZE)
        finally:
            os.close(descriptor)
        self._own_index = own_index
        self._count = self._other_count = 0
        self._silent_s, self._polled_s = 0.0, time.monotonic()

    def update(self, state: int) -> None:
        """Increment the counter of this program, and write its state."""
        self._count += 1
        entry = os.getpid(), _process_state(os.getpid())[1], self._count, state
        _ENTRY.pack_into(self._map, self._own_index * _ENTRY.size, *entry)

    @property
    def other_state(self) -> int:
        """The last state that the other program has written."""
        return self._other_entry().state

    def poll(self) -> str:
        """Check the other program; must be called in each iteration.

        Returns:
            The reason why it does not run, for example `has ended` (also before its first `update`); empty while it
            runs.
        """
        pid, start_ticks, count, _ = self._other_entry()
        now_s = time.monotonic()
        elapsed_s, self._polled_s = min(now_s - self._polled_s, _MAX_POLL_S), now_s
        self._silent_s = self._silent_s + elapsed_s if count == self._other_count else 0.0
        self._other_count = count
        state, other_start_ticks = _process_state(pid)
        if not pid or other_start_ticks != start_ticks or state in _ENDED_STATES:
            return "has ended"
        if state in _SUSPENDED_STATES:
            return "is suspended"
        return f"has not run for {self._silent_s:.1f} s" if self._silent_s > SILENCE_TIMEOUT_S else ""

    def kill_other(self) -> None:
        """Kill the other program, so that it cannot continue later. A process that reuses its pid is not killed."""
        pid, start_ticks, *_ = self._other_entry()
        if pid and _process_state(pid)[1] == start_ticks:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _other_entry(self) -> LifeEntry:
        return entries(self._map[:])[1 - self._own_index]


def _process_state(pid: int) -> tuple[str, int]:
    """Return the state of a process and its start time in clock ticks since boot; `X` and 0 if it does not exist."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:  # noqa: PTH123 (Python 3.8)
            fields = file.read().rpartition(")")[2].split()
        return fields[0], int(fields[19])
    except (OSError, IndexError, ValueError):
        return "X", 0
