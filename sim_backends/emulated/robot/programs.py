"""Which programs a robot has: links, and gaps where this machine has one that the robot lacks."""

import os
import stat
import subprocess
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

from sim_backends.emulated.robot import mounts
from sim_backends.emulated.robot.spec import STATE, Netcat, RobotSpec

NETCATS: Final[dict[Netcat, str]] = {
    "traditional": "nc.traditional",
    "openbsd": "nc.openbsd",
    "ncat": "ncat",
    "busybox": "busybox",
}
"""Debian's program per netcat."""

BUSYBOX: Final = "/usr/bin/busybox"
SFTP_FOLDER: Final = "/usr/lib/openssh"

_BIN: Final = "/usr/bin"
_FOLDERS: Final = (_BIN, "/usr/sbin")

_ANY_NETCAT: Final = ("nc", "netcat", "nc.traditional", "nc.openbsd", "ncat")
# What a robot with a busybox userland has beside it: bash sources ROS's setup files, and Python runs its recorder.
_BESIDE_BUSYBOX: Final = ("bash", "busybox", "dropbear", "python3*", "ros*", "sshd*", "tcpdump")
_TIMEOUT_S: Final = 5.0

Layer = dict[str, str | None]
"""Names in a folder with where each links to; None for a gap."""


def lay(spec: RobotSpec) -> None:
    """Give the robot its own choice of programs; its mount namespace is isolated already.

    Raises:
        OSError: A link could not be made, or the kernel refused a mount.
        SubprocessError: busybox does not say what it has.
    """
    for number, (folder, layer) in enumerate(layers(spec).items()):
        source = Path(STATE, f"programs-{number}")
        source.mkdir(mode=0o755)
        for name, target in layer.items():
            if target is None:
                # How an overlay file system writes that a name of the lower folder is gone.
                os.mknod(source / name, stat.S_IFCHR, os.makedev(0, 0))
            else:
                (source / name).symlink_to(target)
        mounts.lay_over(source, Path(folder))


def layers(spec: RobotSpec) -> dict[str, Layer]:
    """Return what differs from this machine, per folder of programs; nothing for a robot that is like it."""
    busybox = spec.userland == "busybox"
    found = {folder: _gaps(folder) if busybox else {} for folder in _FOLDERS}
    programs = found[_BIN]
    if busybox:
        programs |= dict.fromkeys(_applets(), BUSYBOX)
    if spec.netcat is not None:
        own = NETCATS[spec.netcat]
        programs |= dict.fromkeys((name for name in _ANY_NETCAT if Path(_BIN, name).exists()), None)
        programs.pop(own, None)
        programs["nc"] = f"{_BIN}/{own}"
    if spec.ping == "busybox":
        programs["ping"] = BUSYBOX
    elif spec.ping == "iputils":
        programs.pop("ping", None)
    if not spec.sftp:
        found[SFTP_FOLDER] = {"sftp-server": None}
    return {folder: layer for folder, layer in found.items() if layer}


def _gaps(folder: str) -> Layer:
    """Return a gap for each program that is no part of a busybox robot."""
    names = os.listdir(folder)  # noqa: PTH208 (names are what is wanted)
    return {name: None for name in names if not any(fnmatch(name, kept) for kept in _BESIDE_BUSYBOX)}


def _applets() -> list[str]:
    done = subprocess.run((BUSYBOX, "--list"), capture_output=True, text=True, timeout=_TIMEOUT_S, check=True)
    return done.stdout.split()
