"""CLOCK_BOOTTIME (clock_gettime(2)): a monotonic clock that includes time during which the computer is suspended."""

from __future__ import annotations

import time


def now_s() -> float:
    """Return the time since boot in seconds, or the monotonic clock if CLOCK_BOOTTIME is not available."""
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


def boot_id() -> str:
    """Return the boot ID of the kernel (random(4)), or an empty string if it is unknown."""
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:  # noqa: PTH123 (Python 3.8)
            return file.read(100).strip()
    except (OSError, ValueError):
        return ""
