"""The file system of an emulated robot: the host's, read-only, with folders of its own over what a robot changes."""

import contextlib
import ctypes
import os
import struct
import sys
from collections.abc import Container, Iterable, Iterator
from pathlib import Path
from typing import Final

_LIBC: Final = ctypes.CDLL(None, use_errno=True)

# linux/mount.h
_MS_NOSUID: Final = 0x2
_MS_NODEV: Final = 0x4
_MS_NOEXEC: Final = 0x8
_MS_BIND: Final = 0x1000
_MS_REC: Final = 0x4000
_MNT_DETACH: Final = 0x2
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
        replaced: Files that the robot writes itself: of `/opt`, the children that hold them do not show through; a
            folder at the top that this machine does not have is the robot's own.

    Raises:
        OSError: The kernel refused a mount.
    """
    replaced = tuple(replaced)
    missing = {top for path in replaced if not Path(top := f"/{Path(path).parts[1]}").exists()}
    _make_read_only("/")
    if missing:
        _take_new_root(missing)
    else:
        _mount_proc(Path("/proc"))
    own = {Path(path).parts[2] for path in replaced if path.startswith("/opt/")}
    kept = [*_python_folders(), *(child for child in Path("/opt").glob("*") if child.name not in own)]
    shown = {path: _open_path(path) for path in _outermost(kept) if path.exists()}
    for folder, mode in {**OWN_FOLDERS, **dict.fromkeys(missing, "0755")}.items():
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


def _take_new_root(folders: Iterable[str]) -> None:
    """Take a new root that has all that the old one has, a `/proc` of its own, and `folders`, which that lacks.

    It is made where the new `/proc` would be mounted, so that nothing that must show through is hidden meanwhile.
    """
    root = Path("/proc")
    _mirror(Path("/"), root, without={root.name})
    for folder in (str(root), *folders):
        (root / folder.lstrip("/")).mkdir()
    # While there is an old one: a user namespace gets no new one else (mnt_already_visible in fs/namespace.c).
    _mount_proc(root / "proc")
    os.chdir(root)
    # With both the same folder, the old root comes to lie over the new one, and is taken off again (pivot_root(2)).
    _demand(_LIBC.pivot_root(b".", b"."), "take a new root")
    _demand(_LIBC.umount2(b".", _MNT_DETACH), "take off the old root")
    os.chdir("/")
    _make_read_only("/", flags=0)


def _mirror(folder: Path, at: Path, without: Container[str]) -> None:
    """Mount at `at` what has all that `folder` has, by another way to it, but some names; it can be written to."""
    children = [child for child in folder.iterdir() if child.name not in without]
    _mount("tmpfs", str(at), "tmpfs", _MS_NOSUID | _MS_NODEV, "mode=0755")
    for child in children:
        inside = at / child.name
        if child.is_symlink():
            inside.symlink_to(child.readlink())
            continue
        if child.is_dir():
            inside.mkdir()
        else:
            inside.touch()
        _mount(str(child), str(inside), "", _MS_BIND | _MS_REC)


@contextlib.contextmanager
def remade(folder: Path, at: Path, *, without: Container[str] = ()) -> Iterator[Path]:
    """Yield a folder that has all that the host's `folder` has, to be written to; then it stands there, read-only.

    By mounts alone: a user namespace may lay nothing over a folder with mounts in it, as Docker has in `/etc`.

    Args:
        folder: A folder of the host.
        at: An empty folder of the robot's own to make it in.
        without: Names that it is not to have.

    Raises:
        OSError: The kernel refused a mount.
    """
    _mirror(folder, at, without)
    yield at
    _mount(str(at), str(folder), "", _MS_BIND | _MS_REC)
    _demand(_LIBC.umount2(str(at).encode(), _MNT_DETACH), f"unmount {at}")
    _make_read_only(str(folder), flags=0)


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


def _mount_proc(at: Path) -> None:
    _mount("proc", str(at), "proc", _MS_NOSUID | _MS_NODEV | _MS_NOEXEC)


def _mount(source: str, target: str, kind: str, flags: int, data: str = "") -> None:
    result = _LIBC.mount(source.encode(), target.encode(), kind.encode(), ctypes.c_ulong(flags), data.encode())
    _demand(result, f"mount {kind or source} on {target}")


def _make_read_only(target: str, *, flags: int = _AT_RECURSIVE) -> None:
    """Make `target`, and by default all that is mounted below it, read-only (mount_setattr, Linux 5.12)."""
    attributes = struct.pack("QQQQ", _MOUNT_ATTR_RDONLY, 0, 0, 0)
    arguments = (_SYS_MOUNT_SETATTR, _AT_FDCWD, target.encode(), flags, attributes, len(attributes))
    _demand(_LIBC.syscall(*arguments), f"make {target} read-only")


def _demand(result: int, what: str) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"cannot {what}: {os.strerror(number)}")
