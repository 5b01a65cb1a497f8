"""Root file system of an emulated robot: accounts, host names, keys, ROS setup files, and its tool variants."""

import os
import shlex
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

from sim_backends.emulated.process import worker
from sim_backends.emulated.robot import mounts, ssh_server
from sim_backends.emulated.robot.spec import HOME, NETCATS, ROBOT_FILES, STATE, RobotSpec

SSHD_FOLDER: Final = "/run/sshd"
BOOT_ID: Final = f"{STATE}/boot_id"
"""File that is mounted over the kernel's boot id, which is the same for all robots and does not change when they
reboot."""

_RECORDERS: Final = {
    1: ("rosbag", "sim_backends.emulated.ros.rosbag"),
    2: ("ros2", "sim_backends.emulated.ros.ros2_bag"),
}
"""Built-in recorder per ROS version: name of the program on the robot, and module that implements it."""

_ACCOUNTS: Final = """\
root:x:0:0:root:/root:{shell}
nobody:x:65534:65534:nobody:/nonexistent:/usr/sbin/nologin
sshd:x:100:65534::/run/sshd:/usr/sbin/nologin
tcpdump:x:101:101::/nonexistent:/usr/sbin/nologin
"""
_GROUPS: Final = "root:x:0:\ntty:x:5:\nnogroup:x:65534:\ntcpdump:x:101:\n"
# `*` matches no password; a login with a key is still possible. `!` would lock the account, and sshd without PAM
# refuses any login to a locked account.
_PASSWORDS: Final = "root:*:20000:0:99999:7:::\n"

# On a real robot `python3` is Debian's, which searches this folder after PYTHONPATH. The folder is appended, so that
# the packages of the Python that runs fieldkit are found first.
_SITE_CUSTOMIZE: Final = """\
import sys

if "/usr/lib/python3/dist-packages" not in sys.path:
    sys.path.append("/usr/lib/python3/dist-packages")
"""

BUSYBOX: Final = "/usr/bin/busybox"
SFTP_FOLDER: Final = "/usr/lib/openssh"

_BIN: Final = "/usr/bin"
_SCRIPTS: Final = f"{STATE}/scripts"
_PROGRAM_FOLDERS: Final = (_BIN, "/usr/sbin")

_ALL_NETCATS: Final = ("nc", "netcat", "nc.traditional", "nc.openbsd", "ncat")
# Programs that a robot with a busybox userland keeps: bash sources ROS's setup files, Python runs its recorder, and
# OpenWrt routers have a package of babeld.
_KEPT_WITH_BUSYBOX: Final = (
    "babeld",
    "bash",
    "batctl",
    "busybox",
    "dropbear",
    "hostapd",
    "iperf3",
    "iw",
    "nft",
    "python3*",
    "ros*",
    "sshd*",
    "tcpdump",
    "wpa_supplicant",
)
_TIMEOUT_S: Final = 5.0
"""Timeout of `busybox --list`."""

Layer = dict[str, str | None]
"""Link target per name in a folder of programs; None for a name that is removed."""


def write_files(spec: RobotSpec) -> None:
    """Write the robot's files; its mount namespace must be isolated already.

    Raises:
        OSError: A file could not be written, or the kernel refused a mount.
        SubprocessError: A program of a tool variant failed.
    """
    state = Path(STATE)
    Path(SSHD_FOLDER).mkdir(mode=0o755)
    write_setup(spec)
    (state / "etc").mkdir(mode=0o755, parents=True)
    _write(Path(ssh_server.HOST_KEY), spec.host_key, mode=0o600)
    _write(Path(HOME, ".ssh", "authorized_keys"), f"{spec.authorized_key}\n", mode=0o600)
    files = _etc_files(spec)
    for name, content in files.items():
        _write(state / "etc" / name, content, mode=0o640 if name == "shadow" else 0o644)
    # The files are mounted separately, because a user namespace may not mount over a folder that contains mounts, as
    # `/etc` does in Docker. If this machine lacks one of the files (a minimal Debian has no `hosts`), an overlay of
    # the folder adds them.
    if all(Path(path).exists() for path in ROBOT_FILES):
        for name in files:
            mounts.bind(state / "etc" / name, Path("/etc", name))
    else:
        mounts.mount_overlay(state / "etc", Path("/etc"))
    ssh_server.convert_key(spec)
    mount_programs(spec)
    replace_boot_id()
    mounts.bind(Path(BOOT_ID), Path("/proc/sys/kernel/random/boot_id"))


def write_setup(spec: RobotSpec) -> None:
    """Write the ROS setup files at their paths, and programs beside them: `python3`, `fieldkit`, a built-in recorder.

    A robot with Debian's ROS gets a `sitecustomize.py` instead of the recorder. If the deepest existing folder of a
    path belongs to this machine, the files are added to a mirror of that folder.

    Raises:
        OSError: A file could not be written, or the kernel refused a mount.
    """
    program, module = _RECORDERS[spec.ros_version]
    files = {}
    for path in map(Path, spec.setup):
        files[path] = setup_script(spec, path), 0o644
        # A robot with ROS has middlewares. An emulated robot uses those of the Python that runs fieldkit.
        files[_ros_programs(path) / "python3"] = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n', 0o755
        files[_ros_programs(path) / "fieldkit"] = module_command("fieldkit"), 0o755
        if spec.ros == "builtin":
            files[_ros_programs(path) / program] = module_command(module), 0o755
        else:
            files[_ros_packages(path) / "sitecustomize.py"] = _SITE_CUSTOMIZE, 0o644
    paths_by_folder: dict[Path, list[Path]] = {}
    for path in files:
        folder = next(parent for parent in path.parents if parent.is_dir())
        paths_by_folder.setdefault(folder, []).append(path)
    for folder, paths in paths_by_folder.items():
        with _writable_folder(folder, {path.relative_to(folder).parts[0] for path in paths}) as writable_folder:
            for path in paths:
                content, mode = files[path]
                _write(writable_folder / path.relative_to(folder), content, mode=mode)


@contextmanager
def _writable_folder(folder: Path, replaced_names: set[str]) -> Iterator[Path]:
    """Yield a writable folder for the files of `folder`: the folder itself, or a mirror of a folder of the host."""
    if os.access(folder, os.W_OK):
        yield folder
        return
    mirror = Path(STATE, "copy")
    mirror.mkdir(parents=True)
    with mounts.writable_mirror(folder, mirror, without=replaced_names):
        yield mirror
    mirror.rmdir()


def replace_boot_id() -> None:
    """Give the robot a new boot id, visible at `/proc/sys/kernel/random/boot_id`."""
    Path(BOOT_ID).write_bytes(Path("/proc/sys/kernel/random/uuid").read_bytes())


def setup_script(spec: RobotSpec, path: Path) -> str:
    """Return the content of the ROS setup file `path`: the variables that ROS programs need."""
    variables = {"ROS_DISTRO": spec.distribution, "ROS_VERSION": str(spec.ros_version)}
    if spec.ros_version == 1:
        variables |= spec.ros1_environment
    lines = [f"export {name}={value}" for name, value in variables.items()]
    lines.append(f'export PATH={shlex.quote(str(_ros_programs(path)))}:"$PATH"')
    if spec.ros == "debian":
        lines.append(f'export PYTHONPATH={shlex.quote(str(_ros_packages(path)))}"${{PYTHONPATH:+:$PYTHONPATH}}"')
    return "\n".join(lines) + "\n"


def module_command(module: str) -> str:
    """Return the script that runs a module as a command of the robot; `exec` keeps the process id for signals."""
    command = shlex.join(worker.command(module))
    return f'#!/bin/sh\nPYTHONPATH={shlex.quote(str(worker.PROJECT))} exec {command} "$@"\n'


def _ros_programs(setup: Path) -> Path:
    return setup.parent / "bin"


def _ros_packages(setup: Path) -> Path:
    """Return the folder of Python packages beside a setup file, as in Noetic."""
    return setup.parent / "lib" / "python3" / "dist-packages"


def _etc_files(spec: RobotSpec) -> dict[str, str]:
    """Return the content of the files in `/etc` that each robot has separately, by name."""
    names = "".join(f"{address}\t{name}\n" for name, address in spec.hosts.items())
    return {
        "passwd": _ACCOUNTS.format(shell="/bin/sh" if spec.userland == "busybox" else "/bin/bash"),
        "group": _GROUPS,
        "shadow": _PASSWORDS,
        "hostname": f"{spec.name}\n",
        "hosts": f"127.0.0.1\tlocalhost\n{names}",
    }


def _write(path: Path, content: str, *, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch(mode=mode)
    path.write_text(content, encoding="utf-8")


def mount_programs(spec: RobotSpec) -> None:
    """Mount the robot's tool variants; its mount namespace must be isolated already.

    Raises:
        OSError: A link could not be created, or the kernel refused a mount.
        SubprocessError: busybox did not list its applets.
    """
    for name, script in spec.scripts.items():
        _write(Path(_SCRIPTS, name), f"#!/bin/sh\n{script}\n", mode=0o755)
    for number, (folder, layer) in enumerate(program_layers(spec).items()):
        source = Path(STATE, f"programs-{number}")
        source.mkdir(mode=0o755)
        for name, target in layer.items():
            if target is None:
                # A character device 0/0 in an overlay removes the name of the lower folder (a whiteout).
                os.mknod(source / name, stat.S_IFCHR, os.makedev(0, 0))
            else:
                (source / name).symlink_to(target)
        mounts.mount_overlay(source, Path(folder))


def program_layers(spec: RobotSpec) -> dict[str, Layer]:
    """Return the changes to each folder of programs; empty for a robot with the tools of this machine."""
    has_busybox = spec.userland == "busybox"
    layers = {folder: _removed_programs(folder) if has_busybox else {} for folder in _PROGRAM_FOLDERS}
    programs = layers[_BIN]
    if has_busybox:
        programs |= dict.fromkeys(_applets(), BUSYBOX)
    if spec.netcat is not None:
        program = NETCATS[spec.netcat]
        programs |= dict.fromkeys((name for name in _ALL_NETCATS if Path(_BIN, name).exists()), None)
        programs.pop(program, None)
        programs["nc"] = f"{_BIN}/{program}"
    if spec.ping == "busybox":
        programs["ping"] = BUSYBOX
    elif spec.ping == "iputils":
        programs.pop("ping", None)
    programs |= {name: f"{_SCRIPTS}/{name}" for name in spec.scripts}
    if not spec.sftp:
        layers[SFTP_FOLDER] = {"sftp-server": None}
    return {folder: layer for folder, layer in layers.items() if layer}


def _removed_programs(folder: str) -> Layer:
    """Return the layer that removes the programs that a robot with a busybox userland does not have."""
    names = os.listdir(folder)  # noqa: PTH208 (only names are needed)
    return {name: None for name in names if not any(fnmatch(name, pattern) for pattern in _KEPT_WITH_BUSYBOX)}


def _applets() -> list[str]:
    result = subprocess.run((BUSYBOX, "--list"), capture_output=True, text=True, timeout=_TIMEOUT_S, check=True)
    return result.stdout.split()
