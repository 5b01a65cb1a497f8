"""Names that one process of a user holds at a time: lock files in a folder that no other user can write.

A lock is a `flock`, which the kernel gives back however its process ends. So a file that kill -9 left behind holds
nothing, and the next process that takes a name removes it.
"""

import fcntl
import getpass
import os
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, NoReturn

from fieldkit.core.errors import ConfigurationError, typed

_LONGEST_BASE_BYTES: Final = 60
"""Of a base folder: the name of a Unix socket below it has at most 107 bytes (unix(7))."""

_SUFFIX: Final = ".lock"

_TRIES: Final = 10
_PAUSE_S: Final = 0.02
"""A program that removes unlocked files must lock each for a moment."""


class NameHeldError(ConfigurationError):
    """Another process holds the name."""


def me() -> str:
    """Return `user@laptop`, as it is named on robots."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user id without an account
        user = "unknown"
    return f"{user}@{socket.gethostname()}"


def base_folder() -> Path:
    """Return the folder for this user's files that live as long as a process.

    The first of: `XDG_RUNTIME_DIR`, `/run/user/UID` (freedesktop.org Base Directory Specification), for root `/run`,
    `~/.cache`, if it is this user's and no other user may write there; otherwise the folder of temporary files.
    """
    user = os.geteuid()
    named = filter(None, (os.environ.get("XDG_RUNTIME_DIR"), f"/run/user/{user}", "/run" if user == 0 else ""))
    candidates = [*map(Path, named), *_home_cache()]
    temporary = Path(tempfile.gettempdir())
    return next((path for path in candidates if _only_ours_to_write(path)), temporary)


def _home_cache() -> Iterator[Path]:
    with suppress(RuntimeError):  # a user without a home
        yield Path.home() / ".cache"


def _only_ours_to_write(path: Path) -> bool:
    try:
        status = path.stat()
    except OSError:
        return False
    return (
        path.is_absolute()
        and stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.geteuid()  # after sudo the variables still name another user's folder
        and not status.st_mode & 0o022
        and os.access(path, os.W_OK | os.X_OK)
        and len(os.fsencode(path)) <= _LONGEST_BASE_BYTES
    )


def is_private(status: os.stat_result) -> bool:
    """Return whether this is a folder of this user's that no other user can enter."""
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o077


def not_private(path: Path) -> ConfigurationError:
    """Return the error for a path where another user has put something, or can."""
    remedy = f"remove it, or set XDG_RUNTIME_DIR to a folder of your own: {typed('ls', '-ld', path)}"
    return ConfigurationError("is not this user's alone", where=str(path), remedy=remedy)


@contextmanager
def held(name: str) -> Iterator[None]:
    """Hold a name while the body runs; nothing is left of it then.

    Args:
        name: A file name, of letters, digits and `._@-`, at most 200 bytes.

    Raises:
        NameHeldError: Another process holds it.
        ConfigurationError: The folder for it cannot be made, or is another user's.
    """
    path = base_folder() / f"fieldkit-{os.geteuid()}"
    try:
        folder, lock = _taken(path, f"{name}{_SUFFIX}")
    except OSError as error:
        raise ConfigurationError(
            f"no lock can be held there: {error.strerror or error}",
            where=str(path),
            remedy="set XDG_RUNTIME_DIR to a folder of your own, of mode 700",
        ) from error
    try:
        _remove_stale(folder)
        yield
    finally:
        with suppress(OSError):
            os.unlink(f"{name}{_SUFFIX}", dir_fd=folder)
        os.close(lock)
        os.close(folder)
        with suppress(OSError):  # others hold names there
            path.rmdir()


def _taken(path: Path, file: str) -> tuple[int, int]:
    """Return descriptors of the folder and of the lock file, which is locked and has its name."""
    while True:
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        try:
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # the process that held the last file there has removed it
        except NotADirectoryError as error:
            raise not_private(path) from error
        try:
            lock = _locked(folder, file) if is_private(os.fstat(folder)) else _refused(path)
        except BaseException:
            os.close(folder)
            raise
        if lock is not None:
            return folder, lock
        os.close(folder)


def _refused(path: Path) -> NoReturn:
    raise not_private(path)


def _locked(folder: int, file: str, tries: int = _TRIES) -> int | None:
    """Return the descriptor of a lock file, locked; None if its name or its folder was removed meanwhile.

    Raises:
        NameHeldError: Another process holds it.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        lock = os.open(file, flags, 0o600, dir_fd=folder)
    except FileNotFoundError:
        return None
    try:
        _lock(lock, file, tries)
        if _has_name(lock, file, folder):
            return lock
    except BaseException:
        os.close(lock)
        raise
    os.close(lock)
    return None


def _lock(lock: int, file: str, tries: int) -> None:
    for left in reversed(range(tries)):
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if not left:
                raise NameHeldError("another process holds it", where=file) from error
            time.sleep(_PAUSE_S)
        else:
            return


def _has_name(lock: int, file: str, folder: int) -> bool:
    try:
        return os.path.samestat(os.fstat(lock), os.stat(file, dir_fd=folder, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _remove_stale(folder: int) -> None:
    """Remove the lock files that no process holds."""
    for file in os.listdir(folder):
        if not file.endswith(_SUFFIX):
            continue
        with suppress(OSError, NameHeldError):
            lock = _locked(folder, file, tries=1)
            if lock is not None:
                os.unlink(file, dir_fd=folder)
                os.close(lock)
