"""Named locks between the processes of one user: lock files in a folder to which no other user can write.

A lock is a `flock`, which the kernel releases when its process exits, even after kill -9. A file that was left behind
is therefore not locked, and the next process that acquires any lock removes it.
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

from fieldkit.core.errors import ConfigurationError, shell_command

_MAX_BASE_BYTES: Final = 60
"""Maximum length of the base folder's path. The path of a Unix socket can have at most 107 bytes (unix(7))."""

_SET_RUNTIME_FOLDER: Final = (
    f"set XDG_RUNTIME_DIR to your private folder (mode 700, absolute path of at most {_MAX_BASE_BYTES} bytes)"
)

_SUFFIX: Final = ".lock"

_LOCK_TRIES: Final = 10
_RETRY_INTERVAL_S: Final = 0.02
"""Retries are needed because a process that removes unlocked files locks each of them briefly."""


class NameHeldError(ConfigurationError):
    """Another process holds the lock."""


def user_at_host() -> str:
    """Return `user@laptop`, which identifies the lock holder on robots."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # the user id has no account
        user = "unknown"
    return f"{user}@{socket.gethostname()}"


def base_folder() -> Path:
    """Return the base folder for this user's files that exist only while a process runs.

    The candidates are, in this order, `XDG_RUNTIME_DIR` (freedesktop.org Base Directory Specification),
    `/run/user/UID`, `/run` for root, and `~/.cache`. The base folder is the first of them that belongs to this user,
    is not writable for other users, and has an absolute path of at most `_MAX_BASE_BYTES`. If there is none, it is
    the folder of temporary files.
    """
    user = os.geteuid()
    names = filter(None, (os.environ.get("XDG_RUNTIME_DIR"), f"/run/user/{user}", "/run" if user == 0 else ""))
    candidates = [*map(Path, names), *_home_cache()]
    temporary = Path(tempfile.gettempdir())
    return next((path for path in candidates if _is_safe_base(path)), temporary)


def _home_cache() -> Iterator[Path]:
    with suppress(RuntimeError):  # the user has no home directory
        yield Path.home() / ".cache"


def _is_safe_base(path: Path) -> bool:
    try:
        status = path.stat()
    except OSError:
        return False
    return (
        path.is_absolute()
        and stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.geteuid()  # after sudo, the variables can contain another user's folder
        and not status.st_mode & 0o022
        and os.access(path, os.W_OK | os.X_OK)
        and len(os.fsencode(path)) <= _MAX_BASE_BYTES
    )


def is_private(status: os.stat_result) -> bool:
    """Return True if this is a folder of this user to which no other user has access."""
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o077


def not_private_error(path: Path) -> ConfigurationError:
    """Return the error for a path that is not a folder to which only this user has access."""
    remedy = f"remove it, or {_SET_RUNTIME_FOLDER}: {shell_command('ls', '-ld', path)}"
    return ConfigurationError("it is not a folder to which only you have access", where=str(path), remedy=remedy)


@contextmanager
def hold_lock(name: str) -> Iterator[None]:
    """Hold a named lock while the body runs; its file is removed afterwards.

    Args:
        name: A file name of letters, digits and `._@-`, of at most 200 bytes.

    Raises:
        NameHeldError: Another process holds the lock.
        ConfigurationError: The lock file or its folder cannot be created, or the folder is not private to this user.
    """
    path = base_folder() / f"fieldkit-{os.geteuid()}"
    try:
        folder, lock = _open_and_lock(path, f"{name}{_SUFFIX}")
    except OSError as error:
        raise ConfigurationError(
            f"cannot create a lock file there: {error.strerror or error}",
            where=str(path),
            remedy=_SET_RUNTIME_FOLDER,
        ) from error
    try:
        _remove_stale(folder)
        yield
    finally:
        with suppress(OSError):
            os.unlink(f"{name}{_SUFFIX}", dir_fd=folder)
        os.close(lock)
        os.close(folder)
        with suppress(OSError):  # the folder is not empty if other processes hold locks
            path.rmdir()


def _open_and_lock(path: Path, file: str) -> tuple[int, int]:
    """Return descriptors of the folder and of the locked file, after checking that the file still has its name."""
    while True:
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        try:
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            continue  # the process that held the last lock has removed the folder
        except NotADirectoryError as error:
            raise not_private_error(path) from error
        try:
            lock = _try_lock_file(folder, file) if is_private(os.fstat(folder)) else _raise_not_private(path)
        except BaseException:
            os.close(folder)
            raise
        if lock is not None:
            return folder, lock
        os.close(folder)


def _raise_not_private(path: Path) -> NoReturn:
    raise not_private_error(path)


def _try_lock_file(folder: int, file: str, tries: int = _LOCK_TRIES) -> int | None:
    """Return the descriptor of a locked file, or None if the file or its folder was removed in the meantime.

    Raises:
        NameHeldError: Another process holds the lock.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        lock = os.open(file, flags, 0o600, dir_fd=folder)
    except FileNotFoundError:
        return None
    try:
        _lock_with_retries(lock, file, tries)
        if _has_name(lock, file, folder):
            return lock
    except BaseException:
        os.close(lock)
        raise
    os.close(lock)
    return None


def _lock_with_retries(lock: int, file: str, tries: int) -> None:
    for tries_left in reversed(range(tries)):
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if not tries_left:
                raise NameHeldError("another process holds this lock", where=file) from error
            time.sleep(_RETRY_INTERVAL_S)
        else:
            return


def _has_name(lock: int, file: str, folder: int) -> bool:
    try:
        return os.path.samestat(os.fstat(lock), os.stat(file, dir_fd=folder, follow_symlinks=False))
    except FileNotFoundError:
        return False


def _remove_stale(folder: int) -> None:
    """Remove the files that no process has locked."""
    for file in os.listdir(folder):
        if not file.endswith(_SUFFIX):
            continue
        with suppress(OSError, NameHeldError):
            lock = _try_lock_file(folder, file, tries=1)
            if lock is not None:
                os.unlink(file, dir_fd=folder)
                os.close(lock)
