"""Builds the file system of an emulated robot: read-only files of the host, and folders that the robot can change."""

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
# asm-generic/unistd.h: the same number on x86-64 and arm64. glibc has the function `mount_setattr` only since 2.36.
_SYS_MOUNT_SETATTR: Final = 442
_AT_FDCWD: Final = -100
_AT_RECURSIVE: Final = 0x8000

ROBOT_FOLDERS: Final = {
    "/root": "0700",
    "/home": "0755",
    "/opt": "0755",
    "/run": "0755",
    "/tmp": "1777",  # noqa: S108 (in the robot, initially empty)
    "/var/log": "0755",
    "/var/tmp": "1777",  # noqa: S108 (in the robot, initially empty)
    "/dev/shm": "1777",  # noqa: S108 (in the robot, initially empty)
    "/sys/class/power_supply": "0755",  # hides the battery of the host
}
"""Folders that each robot has separately, with their modes, as far as this machine has them; their content is lost
when the robot stops."""


def isolate(*, replaced_files: Iterable[str] = ()) -> None:
    """Mount the robot's folders in this process's mount namespace, and make the host's file systems read-only there.

    The robot's folders are empty, except for files of the host that the robot needs: this Python, its packages (also
    this one), and the children of `/opt`, unless `replaced_files` replaces them. `/proc` and `/dev/pts` are new.

    Args:
        replaced_files: Files that the robot writes itself. Children of `/opt` that contain them are hidden; a
            top-level folder that this machine does not have is created for the robot.

    Raises:
        OSError: The kernel refused a mount.
    """
    replaced_files = tuple(replaced_files)
    # Top-level folders of these files that this machine does not have.
    missing = {top for path in replaced_files if not Path(top := f"/{Path(path).parts[1]}").exists()}
    _make_read_only("/")
    if missing:
        _pivot_root(missing)
    else:
        _mount_proc(Path("/proc"))
    replaced_in_opt = {Path(path).parts[2] for path in replaced_files if path.startswith("/opt/")}
    visible = [*_python_folders(), *(child for child in Path("/opt").glob("*") if child.name not in replaced_in_opt)]
    open_fds = {path: _open_path(path) for path in _outermost(visible) if path.exists()}
    for folder, mode in {**ROBOT_FOLDERS, **dict.fromkeys(missing, "0755")}.items():
        if Path(folder).is_dir():
            _mount("tmpfs", folder, "tmpfs", _MS_NOSUID | _MS_NODEV, f"mode={mode}")
    for path, fd in open_fds.items():
        _bind_again(path, fd)
    _mount("devpts", "/dev/pts", "devpts", _MS_NOSUID | _MS_NOEXEC, "newinstance,ptmxmode=0666,mode=620,gid=5")
    _mount("/dev/pts/ptmx", "/dev/ptmx", "", _MS_BIND)


def mount_overlay(source: Path, target: Path) -> None:
    """Mount the files of the folder `source` over the folder `target`; other files of `target` stay visible.

    Raises:
        OSError: The kernel refused, or has no overlay file system.
    """
    # Two lower layers without an upper one: the result is read-only, like the host's folders.
    _mount("overlay", str(target), "overlay", 0, f"lowerdir={source}:{target}")


def bind(source: Path, target: Path) -> None:
    """Bind-mount `source` over `target`, which must exist and be of the same kind.

    Raises:
        OSError: The kernel refused.
    """
    _mount(str(source), str(target), "", _MS_BIND)


def clear(folder: Path, keep: Iterable[str] = ()) -> None:
    """Remove the content of `folder`, except `keep` and the host's folders that are mounted below it.

    Raises:
        OSError: A file could not be removed.
    """
    device = folder.stat().st_dev
    for path in folder.iterdir():
        if path.lstat().st_dev != device or str(path) in keep:
            continue
        if path.is_symlink() or not path.is_dir():
            path.unlink()
            continue
        clear(path, keep)
        with contextlib.suppress(OSError):  # not empty, because a mount is below it
            path.rmdir()


def _pivot_root(folders: Iterable[str]) -> None:
    """Change to a new root with the content of the old root, a new `/proc`, and `folders`, which the old root lacks.

    The new root is built at `/proc`, so that it hides nothing else until the change.
    """
    root = Path("/proc")
    _mirror(Path("/"), root, without={root.name})
    for folder in (str(root), *folders):
        (root / folder.lstrip("/")).mkdir()
    # This needs the old `/proc`: without it a user namespace may not mount a new one (mnt_already_visible in
    # fs/namespace.c).
    _mount_proc(root / "proc")
    os.chdir(root)
    # If both arguments are the same folder, the old root is mounted over the new one; then it is unmounted
    # (pivot_root(2)).
    _check(_LIBC.pivot_root(b".", b"."), "change to the new root")
    _check(_LIBC.umount2(b".", _MNT_DETACH), "unmount the old root")
    os.chdir("/")
    _make_read_only("/", flags=0)


def _mirror(folder: Path, at: Path, without: Container[str]) -> None:
    """Mount a writable folder at `at` with bind mounts of all that `folder` contains, except the names `without`."""
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
def writable_mirror(folder: Path, at: Path, *, without: Container[str] = ()) -> Iterator[Path]:
    """Yield a writable mirror of the host's `folder`; when the context is left, mount it over `folder`, read-only.

    The mirror consists of bind mounts, because a user namespace may not overlay a folder that contains mounts, as
    `/etc` does in Docker.

    Args:
        folder: A folder of the host.
        at: An empty folder of the robot in which the mirror is built.
        without: Names that the mirror omits.

    Raises:
        OSError: The kernel refused a mount.
    """
    _mirror(folder, at, without)
    yield at
    _mount(str(at), str(folder), "", _MS_BIND | _MS_REC)
    _check(_LIBC.umount2(str(at).encode(), _MNT_DETACH), f"unmount {at}")
    _make_read_only(str(folder), flags=0)


def _python_folders() -> list[Path]:
    """Return the folders of this interpreter and its modules.

    They include each folder on the interpreter's chain of symbolic links. Each folder is returned both as it is
    written and with all symbolic links resolved.
    """
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
    """Return the paths that the robot's folders hide; a path inside another of these paths is omitted."""
    hidden = {path for path in paths if any(Path(folder) in path.parents for folder in ROBOT_FOLDERS)}
    return [path for path in hidden if not any(parent in hidden for parent in path.parents)]


def _open_path(path: Path) -> int:
    return os.open(path, os.O_PATH | os.O_CLOEXEC)


def _bind_again(path: Path, fd: int) -> None:
    """Bind-mount the file or folder that is open as `fd` at its path, where another mount hides it now."""
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
    _check(result, f"mount {kind or source} on {target}")


def _make_read_only(target: str, *, flags: int = _AT_RECURSIVE) -> None:
    """Make `target`, and by default everything mounted below it, read-only (mount_setattr, Linux 5.12)."""
    attributes = struct.pack("QQQQ", _MOUNT_ATTR_RDONLY, 0, 0, 0)
    arguments = (_SYS_MOUNT_SETATTR, _AT_FDCWD, target.encode(), flags, attributes, len(attributes))
    _check(_LIBC.syscall(*arguments), f"make {target} read-only")


def _check(result: int, action: str) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"cannot {action}: {os.strerror(number)}")
