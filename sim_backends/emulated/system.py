"""What stands in an emulated robot's own folders: accounts, host names, keys, ROS setup files, commands."""

import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from sim_backends.emulated import mounts
from sim_backends.emulated.spec import HOME, ROS_MASTER_PORT, STATE, RobotSpec

HOST_KEY: Final = f"{STATE}/ssh_host_ed25519_key"
PROJECT: Final = Path(__file__).resolve().parents[2]
"""Folder from which Python imports this package."""

_ACCOUNTS: Final = """\
root:x:0:0:root:/root:/bin/bash
nobody:x:65534:65534:nobody:/nonexistent:/usr/sbin/nologin
sshd:x:100:65534::/run/sshd:/usr/sbin/nologin
tcpdump:x:101:101::/nonexistent:/usr/sbin/nologin
"""
_GROUPS: Final = "root:x:0:\ntty:x:5:\nnogroup:x:65534:\ntcpdump:x:101:\n"
# `*` is no password; the account is open to keys. `!` would lock it, and sshd without PAM refuses locked accounts.
_PASSWORDS: Final = "root:*:20000:0:99999:7:::\n"


def furnish(spec: RobotSpec) -> None:
    """Write the robot's files; its mount namespace is isolated already.

    Raises:
        OSError: A file could not be written, or the kernel refused a mount.
    """
    state = Path(STATE)
    Path("/run/sshd").mkdir(mode=0o755)
    (state / "etc").mkdir(mode=0o755, parents=True)
    _write(Path(HOST_KEY), spec.host_key, mode=0o600)
    _write(Path(HOME, ".ssh", "authorized_keys"), f"{spec.authorized_key}\n", mode=0o600)
    for name, content in _etc(spec).items():
        _write(state / "etc" / name, content, mode=0o640 if name == "shadow" else 0o644)
    mounts.lay_over(state / "etc", Path("/etc"))
    for path in spec.setup:
        _write(Path(path), setup_script(spec.ros, spec.distribution, Path(path)))
        if spec.ros == "builtin":
            _write(_programs(Path(path)) / "rosbag", rosbag_command(), mode=0o755)


def setup_script(ros: str, distribution: str, path: Path) -> str:
    """Return the ROS setup file `path`: the variables that a session needs to find ROS."""
    variables = {
        "ROS_DISTRO": distribution,
        "ROS_VERSION": "1",
        "ROS_MASTER_URI": f"http://127.0.0.1:{ROS_MASTER_PORT}",
        "ROS_IP": "127.0.0.1",
    }
    lines = [f"export {name}={value}" for name, value in variables.items()]
    if ros == "builtin":
        lines.append(f'export PATH={shlex.quote(str(_programs(path)))}:"$PATH"')
    return "\n".join(lines) + "\n"


def rosbag_command() -> str:
    """Return the script that stands as `rosbag` on the robot; `exec` keeps signals and process id its own."""
    command = shlex.join([*python("sim_backends.emulated.rosbag")])
    return f'#!/bin/sh\nPYTHONPATH={shlex.quote(str(PROJECT))} exec {command} "$@"\n'


def python(module: str) -> list[str]:
    """Return the command that runs a module of this package, with `PYTHONPATH` set to `PROJECT`.

    Neither the working directory nor a user's site-packages can put another module in its way.
    """
    return [sys.executable, "-P", "-s", "-m", module]


def _programs(setup: Path) -> Path:
    return setup.parent / "bin"


def _etc(spec: RobotSpec) -> dict[str, str]:
    names = "".join(f"{address}\t{name}\n" for name, address in spec.hosts.items())
    return {
        "passwd": _ACCOUNTS,
        "group": _GROUPS,
        "shadow": _PASSWORDS,
        "hostname": f"{spec.name}\n",
        "hosts": f"127.0.0.1\tlocalhost\n{names}",
    }


def _write(path: Path, content: str, *, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch(mode=mode)
    path.write_text(content, encoding="utf-8")


def outside_own_folders(paths: Iterable[str]) -> list[str]:
    """Return those of `paths` that no robot can hold, because it shares the folder with the host."""
    writable = [Path(folder) for folder in mounts.OWN_FOLDERS if folder not in {"/run", "/dev/shm"}]  # noqa: S108
    return [path for path in paths if not any(folder in Path(path).parents for folder in writable)]
