"""A clock that also counts the time for which the whole computer was suspended: CLOCK_BOOTTIME (clock_gettime(2))."""

from __future__ import annotations

import time


def now_s() -> float:
    """Return the time in seconds since the computer was switched on; of the monotonic clock if that is unknown."""
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


def boot_id() -> str:
    """Return what identifies this run of the kernel (random(4)); empty if that is unknown."""
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:  # noqa: PTH123 (Python 3.8)
            return file.read(100).strip()
    except (OSError, ValueError):
        return ""
