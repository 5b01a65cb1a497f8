"""Root file system of an emulated robot: accounts, host names, keys, ROS setup files, and its choice of programs."""

import os
import shlex
import stat
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Final

from sim_backends.emulated.process import interpreter
from sim_backends.emulated.robot import mounts, ssh_server
from sim_backends.emulated.robot.spec import HOME, STATE, Netcat, RobotSpec

SSHD_FOLDER: Final = "/run/sshd"
BOOT_ID: Final = f"{STATE}/boot_id"
"""Stands over the kernel's own, which all robots of this machine share and no reboot of one changes."""

_RECORDERS: Final = {
    1: ("rosbag", "sim_backends.emulated.ros.rosbag"),
    2: ("ros2", "sim_backends.emulated.ros.ros2_bag"),
}
"""Built-in recorder per ROS version: its name on the robot, and the module behind it."""

_ACCOUNTS: Final = """\
root:x:0:0:root:/root:{shell}
nobody:x:65534:65534:nobody:/nonexistent:/usr/sbin/nologin
sshd:x:100:65534::/run/sshd:/usr/sbin/nologin
tcpdump:x:101:101::/nonexistent:/usr/sbin/nologin
"""
_GROUPS: Final = "root:x:0:\ntty:x:5:\nnogroup:x:65534:\ntcpdump:x:101:\n"
# `*` is no password; the account is open to keys. `!` would lock it, and sshd without PAM refuses locked accounts.
_PASSWORDS: Final = "root:*:20000:0:99999:7:::\n"

OWN_FILES: Final = tuple(f"/etc/{name}" for name in ("passwd", "group", "shadow", "hostname", "hosts"))
"""Files of the system that a robot has its own of."""

NETCATS: Final[dict[Netcat, str]] = {
    "traditional": "nc.traditional",
    "openbsd": "nc.openbsd",
    "ncat": "ncat",
    "busybox": "busybox",
}
"""Debian's program per netcat."""

# On a real robot `python3` is Debian's own, which has these behind PYTHONPATH. Appended, so that the packages of the
# Python that runs fieldkit come first.
_SITE_CUSTOMIZE: Final = """\
import sys

if "/usr/lib/python3/dist-packages" not in sys.path:
    sys.path.append("/usr/lib/python3/dist-packages")
"""

BUSYBOX: Final = "/usr/bin/busybox"
SFTP_FOLDER: Final = "/usr/lib/openssh"

_BIN: Final = "/usr/bin"
_KERNELS: Final = ("/proc/", "/sys/", "/dev/")
_FOLDERS: Final = (_BIN, "/usr/sbin")

_ANY_NETCAT: Final = ("nc", "netcat", "nc.traditional", "nc.openbsd", "ncat")
# What a robot with a busybox userland has beside it: bash sources ROS's setup files, Python runs its recorder, and a
# router with OpenWrt has babeld from a package.
_BESIDE_BUSYBOX: Final = ("babeld", "bash", "busybox", "dropbear", "iperf3", "python3*", "ros*", "sshd*", "tcpdump")
_TIMEOUT_S: Final = 5.0

Layer = dict[str, str | None]
"""Names in a folder with where each links to; None for a gap."""


def furnish(spec: RobotSpec) -> None:
    """Write the robot's files; its mount namespace is isolated already.

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
    own = _etc(spec)
    for name, content in own.items():
        _write(state / "etc" / name, content, mode=0o640 if name == "shadow" else 0o644)
    # One by one, because a user namespace may lay nothing over a folder with mounts in it, as Docker has; over the
    # folder where this machine lacks one of them, as a bare Debian lacks hosts.
    if all(Path(path).exists() for path in OWN_FILES):
        for name in own:
            mounts.bind(state / "etc" / name, Path("/etc", name))
    else:
        mounts.lay_over(state / "etc", Path("/etc"))
    ssh_server.convert_key(spec)
    lay_programs(spec)
    new_boot_id()
    mounts.bind(Path(BOOT_ID), Path("/proc/sys/kernel/random/boot_id"))


def write_setup(spec: RobotSpec) -> None:
    """Write the ROS setup files wherever they are to lie, and the built-in recorder beside them.

    Where the deepest folder that is there is this machine's, they stand in it beside what it has.

    Raises:
        OSError: A file could not be written, or the kernel refused a mount.
    """
    program, module = _RECORDERS[spec.ros_version]
    files = {}
    for path in map(Path, spec.setup):
        files[path] = setup_script(spec, path), 0o644
        # A robot with ROS has its middlewares: here those of the Python that runs fieldkit.
        files[_ros_programs(path) / "python3"] = f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n', 0o755
        files[_ros_programs(path) / "fieldkit"] = module_command("fieldkit"), 0o755
        if spec.ros == "builtin":
            files[_ros_programs(path) / program] = module_command(module), 0o755
        else:
            files[_ros_packages(path) / "sitecustomize.py"] = _SITE_CUSTOMIZE, 0o644
    beside: dict[Path, list[Path]] = {}
    for path in files:
        folder = next(parent for parent in path.parents if parent.is_dir())
        beside.setdefault(folder, []).append(path)
    for folder, paths in beside.items():
        with _writable(folder, {path.relative_to(folder).parts[0] for path in paths}) as place:
            for path in paths:
                content, mode = files[path]
                _write(place / path.relative_to(folder), content, mode=mode)


@contextmanager
def _writable(folder: Path, replaced: set[str]) -> Iterator[Path]:
    """Yield where to write what is to stand in `folder`: there, or in a copy of what is the host's."""
    if os.access(folder, os.W_OK):
        yield folder
        return
    place = Path(STATE, "copy")
    place.mkdir(parents=True)
    with mounts.remade(folder, place, without=replaced):
        yield place
    place.rmdir()


def new_boot_id() -> None:
    """Write another id of the boot where `/proc/sys/kernel/random/boot_id` shows it."""
    Path(BOOT_ID).write_bytes(Path("/proc/sys/kernel/random/uuid").read_bytes())


def setup_script(spec: RobotSpec, path: Path) -> str:
    """Return the ROS setup file `path`: the variables that a session needs to find ROS."""
    variables = {"ROS_DISTRO": spec.distribution, "ROS_VERSION": str(spec.ros_version)}
    if spec.ros_version == 1:
        variables |= spec.ros1_environment
    lines = [f"export {name}={value}" for name, value in variables.items()]
    lines.append(f'export PATH={shlex.quote(str(_ros_programs(path)))}:"$PATH"')
    if spec.ros == "debian":
        lines.append(f'export PYTHONPATH={shlex.quote(str(_ros_packages(path)))}"${{PYTHONPATH:+:$PYTHONPATH}}"')
    return "\n".join(lines) + "\n"


def module_command(module: str) -> str:
    """Return the script that runs a module as a command of the robot; `exec` keeps signals and process id its own."""
    command = shlex.join(interpreter.command(module))
    return f'#!/bin/sh\nPYTHONPATH={shlex.quote(str(interpreter.PROJECT))} exec {command} "$@"\n'


def _ros_programs(setup: Path) -> Path:
    return setup.parent / "bin"


def _ros_packages(setup: Path) -> Path:
    """Return the folder of Python packages beside a setup file, as Noetic has it."""
    return setup.parent / "lib" / "python3" / "dist-packages"


def _etc(spec: RobotSpec) -> dict[str, str]:
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


def unsupported_paths(paths: Iterable[str]) -> list[str]:
    """Return those of `paths` at which no robot can have a file: the kernel's folders, and the root itself."""
    return [path for path in paths if path.startswith(_KERNELS) or path.count("/") == 1]


def lay_programs(spec: RobotSpec) -> None:
    """Give the robot its own choice of programs; its mount namespace is isolated already.

    Raises:
        OSError: A link could not be made, or the kernel refused a mount.
        SubprocessError: busybox does not say what it has.
    """
    for number, (folder, layer) in enumerate(program_layers(spec).items()):
        source = Path(STATE, f"programs-{number}")
        source.mkdir(mode=0o755)
        for name, target in layer.items():
            if target is None:
                # How an overlay file system writes that a name of the lower folder is gone.
                os.mknod(source / name, stat.S_IFCHR, os.makedev(0, 0))
            else:
                (source / name).symlink_to(target)
        mounts.lay_over(source, Path(folder))


def program_layers(spec: RobotSpec) -> dict[str, Layer]:
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
