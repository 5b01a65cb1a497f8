"""What befalls an emulated robot on purpose, done by its init process: a process dies, the memory is lost."""

import os
import signal
from pathlib import Path
from typing import Final

from fieldkit.core.errors import RobotError
from sim_backends.emulated.robot import mounts, services, system
from sim_backends.emulated.robot.spec import STATE

VOLATILE: Final = ("/tmp", "/run", "/dev/shm")  # noqa: S108 (the robot's own)
"""Folders that a robot holds in memory; the others lie on its SD card."""


def kill(process: str) -> None:
    """End every process of the robot that has this name, but the first one, without warning.

    Raises:
        RobotError: There is none.
    """
    found = [pid for pid in _pids() if pid != os.getpid() and _name(pid) == process]
    if not found:
        raise RobotError(f"no process named {process} runs", remedy="on the robot: cat /proc/[0-9]*/comm | sort -u")
    for pid in found:
        os.kill(pid, signal.SIGKILL)


def forget() -> None:
    """Lose what a robot loses with its power: what lies in memory, and the name of this boot."""
    for folder in VOLATILE:
        mounts.clear(Path(folder), keep=(STATE, system.SSHD_FOLDER))
    mounts.clear(Path(services.READY_FOLDER))
    system.new_boot_id()


def _pids() -> list[int]:
    return [int(path.name) for path in Path("/proc").glob("[0-9]*")]


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text(encoding="utf-8", errors="replace").rstrip("\n")
    except OSError:
        return ""  # it ended meanwhile
