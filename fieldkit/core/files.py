"""Files that a crash leaves whole, the disk that they need, and the plain ones among what others made."""

import errno
import os
import shutil
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Final

_SYNCS: Final = 16
"""How many files are brought to disk at once."""

_SHARED: Final = "it has a second name, a hard link, and writing it would change that file too"


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a file that takes the place of `path` when the body ends: a crash leaves one of the two, whole.

    A file that was there keeps its mode; when the body raises, it stays. A link that was there is replaced, and what
    it leads to stays as it is. A device (/dev/null, to root), a pipe or a socket is not replaced.

    Raises:
        OSError: It cannot be written; what was there stays.
    """
    temporary = path.with_name(f".{path.name}.new")
    with suppress(FileNotFoundError):
        mode = path.lstat().st_mode
        if not stat.S_ISLNK(mode) and (what := kind(mode)):
            raise OSError(errno.EINVAL, what, str(path))
    try:
        with suppress(FileNotFoundError):
            temporary.unlink()  # of a crash, or laid there by somebody as a link to another file
        with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:
            with suppress(FileNotFoundError):
                if stat.S_ISREG(mode := path.lstat().st_mode):
                    os.fchmod(file.fileno(), stat.S_IMODE(mode))
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.rename(path)
    except OSError as error:
        if error.filename is None:  # a write that failed does not say what it wrote
            error.filename = str(path)
        raise
    finally:
        with suppress(OSError):  # what went wrong before is told
            temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def write(path: Path, content: bytes) -> None:
    """Write a file whole, as `replacing`.

    Raises:
        OSError: It cannot be written; what was there stays.
    """
    with replacing(path) as file:
        file.write(content)


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """Return a descriptor of a plain file; no link is followed, and nothing that could block is waited for.

    Args:
        path: The file.
        flags: Of `os.open`; a file that is made has the mode 644.

    Raises:
        OSError: There is none, it is something else, or it is to be written and has a second name.
    """
    try:
        descriptor = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    except OSError as error:
        # What opening a link, and a pipe or a socket to write into, fails with.
        if error.errno in {errno.ELOOP, errno.ENXIO} and (what := foreign(path)):
            raise OSError(error.errno, what, str(path)) from error
        raise
    status = os.fstat(descriptor)
    writes = flags & (os.O_WRONLY | os.O_RDWR)
    if stat.S_ISREG(status.st_mode) and not (writes and status.st_nlink > 1):
        return descriptor
    os.close(descriptor)
    raise OSError(errno.EINVAL, kind(status.st_mode) or _SHARED, str(path))


def read(path: Path, limit_bytes: int | None = None) -> bytes:
    """Return the content of a plain file.

    Raises:
        OSError: As `open_plain`; or it is larger than `limit_bytes`.
    """
    with os.fdopen(open_plain(path), "rb") as file:
        if limit_bytes is not None and os.fstat(file.fileno()).st_size > limit_bytes:
            raise OSError(errno.EFBIG, f"it is larger than {limit_bytes >> 20} MiB", str(path))
        return file.read()


def kind(mode: int) -> str:
    """Return what something is that is neither a plain file nor a folder, empty for one of the two."""
    kinds = (
        (stat.S_ISLNK, "it is a symbolic link"),
        (stat.S_ISFIFO, "it is a pipe"),
        (stat.S_ISSOCK, "it is a socket"),
        (lambda one: stat.S_ISBLK(one) or stat.S_ISCHR(one), "it is a device"),
    )
    return next((f"{what}, no file of its own" for holds, what in kinds if holds(mode)), "")


def foreign(path: Path) -> str:
    """Return what is at `path` in place of a file or a folder, empty where one of them is, or nothing."""
    try:
        return kind(path.lstat().st_mode)
    except FileNotFoundError:
        return ""


def sync_folder(folder: Path) -> None:
    """Return when the names in a folder are on disk."""
    _sync(folder, os.O_RDONLY | os.O_DIRECTORY)


def sync(paths: Collection[Path]) -> None:
    """Return when plain files, and the names in folders, are on disk.

    They are brought there side by side, so that one commit of the file system's journal takes many of them: on ext4,
    14 small files took 1.3 ms in place of 34 ms one after the other.
    """
    from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415 (with logging, 5 ms)

    with ThreadPoolExecutor(_SYNCS) as pool:
        for _ in pool.map(_sync, paths):
            pass


def _sync(path: Path, flags: int = os.O_RDONLY) -> None:
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def existing(folder: Path) -> Path:
    """Return a folder, or the innermost of those around it that is there already."""
    whole = folder.absolute()
    return next(path for path in (whole, *whole.parents) if path.is_dir())


def free_bytes(folder: Path) -> int:
    """Return how many bytes are free on the disk that `folder` is on, or will be."""
    return shutil.disk_usage(existing(folder)).free
