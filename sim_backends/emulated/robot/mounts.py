"""The file system of an emulated robot: the host's, read-only, with folders of its own over what a robot changes."""

import contextlib
import ctypes
import os
import struct
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

_LIBC: Final = ctypes.CDLL(None, use_errno=True)

# linux/mount.h
_MS_NOSUID: Final = 0x2
_MS_NODEV: Final = 0x4
_MS_NOEXEC: Final = 0x8
_MS_BIND: Final = 0x1000
_MS_REC: Final = 0x4000
_MOUNT_ATTR_RDONLY: Final = 0x1
# asm-generic/unistd.h, the same number on x86-64 and arm64; in no libc that Debian 12 has.
_SYS_MOUNT_SETATTR: Final = 442
_AT_FDCWD: Final = -100
_AT_RECURSIVE: Final = 0x8000

OWN_FOLDERS: Final = {
    "/root": "0700",
    "/home": "0755",
    "/opt": "0755",
    "/run": "0755",
    "/tmp": "1777",  # noqa: S108 (the robot's own, fresh)
    "/var/log": "0755",
    "/var/tmp": "1777",  # noqa: S108 (the robot's own, fresh)
    "/dev/shm": "1777",  # noqa: S108 (the robot's own, fresh)
    "/sys/class/power_supply": "0755",  # or a laptop's battery would be the robot's
}
"""Folders that a robot has for itself, with their modes; what it writes there ends with it."""


def isolate(*, replaced: Iterable[str] = ()) -> None:
    """Give this process's mount namespace the robot's own folders, and make all the host's read-only.

    What of the host must stay usable shows through: this Python, this package, and everything in `/opt`.

    Args:
        replaced: Paths in `/opt` that the robot writes itself: the children that hold them do not show through.

    Raises:
        OSError: The kernel refused a mount.
    """
    _make_read_only("/")
    _mount("proc", "/proc", "proc", _MS_NOSUID | _MS_NODEV | _MS_NOEXEC)
    own = {Path(path).parts[2] for path in replaced if path.startswith("/opt/")}
    kept = [*_python_folders(), *(child for child in Path("/opt").glob("*") if child.name not in own)]
    shown = {path: _open_path(path) for path in _outermost(kept) if path.exists()}
    for folder, mode in OWN_FOLDERS.items():
        if Path(folder).is_dir():
            _mount("tmpfs", folder, "tmpfs", _MS_NOSUID | _MS_NODEV, f"mode={mode}")
    for path, fd in shown.items():
        _show(path, fd)
    _mount("devpts", "/dev/pts", "devpts", _MS_NOSUID | _MS_NOEXEC, "newinstance,ptmxmode=0666,mode=620,gid=5")
    _mount("/dev/pts/ptmx", "/dev/ptmx", "", _MS_BIND)


def lay_over(source: Path, target: Path) -> None:
    """Let the files of the folder `source` stand in the folder `target`, over those of the same name or beside them.

    Raises:
        OSError: The kernel refused, or has no overlay file system.
    """
    # Two lower layers and no upper one: the result is read-only, as the host's folders are.
    _mount("overlay", str(target), "overlay", 0, f"lowerdir={source}:{target}")


def bind(source: Path, target: Path) -> None:
    """Let `source` stand at `target`, of the same kind and there already.

    Raises:
        OSError: The kernel refused.
    """
    _mount(str(source), str(target), "", _MS_BIND)


def clear(folder: Path, keep: Iterable[str] = ()) -> None:
    """Remove all that lies in `folder` itself; `keep`, and what is mounted below it, which is the host's, stay.

    Raises:
        OSError: Something could not be removed.
    """
    own_device = folder.stat().st_dev
    for path in folder.iterdir():
        if path.lstat().st_dev != own_device or str(path) in keep:
            continue
        if path.is_symlink() or not path.is_dir():
            path.unlink()
            continue
        clear(path, keep)
        with contextlib.suppress(OSError):  # not empty: a mount is below it
            path.rmdir()


def _python_folders() -> list[Path]:
    """Return the folders that this interpreter and its modules live in, by every name that leads to them."""
    folders = [Path(sys.prefix), Path(sys.base_prefix), *map(Path, sys.path)]
    program = Path(sys.executable)
    while True:
        folders.append(program.parent)
        if not program.is_symlink():
            break
        program = program.parent / program.readlink()
    folders += [folder.resolve() for folder in folders]
    return [folder for folder in folders if folder.is_absolute() and folder.is_dir()]


def _outermost(paths: Iterable[Path]) -> list[Path]:
    """Return those of `paths` that lie in the robot's own folders, without the ones inside another."""
    hidden = {path for path in paths if any(Path(own) in path.parents for own in OWN_FOLDERS)}
    return [path for path in hidden if not any(parent in hidden for parent in path.parents)]


def _open_path(path: Path) -> int:
    return os.open(path, os.O_PATH | os.O_CLOEXEC)


def _show(path: Path, fd: int) -> None:
    """Bind what was open as `fd` to its old name in the folder that now hides it."""
    source = f"/proc/self/fd/{fd}"
    path.parent.mkdir(parents=True, exist_ok=True)
    if Path(source).is_dir():
        path.mkdir(exist_ok=True)
    else:
        path.touch()
    _mount(source, str(path), "", _MS_BIND | _MS_REC)
    os.close(fd)


def _mount(source: str, target: str, kind: str, flags: int, data: str = "") -> None:
    result = _LIBC.mount(source.encode(), target.encode(), kind.encode(), ctypes.c_ulong(flags), data.encode())
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"cannot mount {kind or source} on {target}: {os.strerror(number)}")


def _make_read_only(target: str) -> None:
    """Make `target` and all that is mounted below it read-only (mount_setattr, Linux 5.12)."""
    attributes = struct.pack("QQQQ", _MOUNT_ATTR_RDONLY, 0, 0, 0)
    arguments = (_SYS_MOUNT_SETATTR, _AT_FDCWD, target.encode(), _AT_RECURSIVE, attributes, len(attributes))
    if _LIBC.syscall(*arguments) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"cannot make {target} read-only: {os.strerror(number)}")
