"""Files of a link server: a Unix-domain socket, a lock file and a log of errors in a private folder.

Their names contain a hash of the connection, the network namespace and the boot ID, so that connections of different
robots with a shared home folder, or of containers, are not confused.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import socket
import stat
import struct
from contextlib import contextmanager, suppress
from typing import Iterator

_FOLDER = ("~", ".fieldkit", "links")
_CREDENTIALS = struct.Struct("iII")


def folder() -> str:
    """Return the folder of sockets, which only this user can access.

    Raises:
        OSError: The folder cannot be created, or belongs to another user.
    """
    path = os.path.expanduser(os.path.join(*_FOLDER))  # noqa: PTH111, PTH118 (Python 3.8)
    os.makedirs(path, mode=0o700, exist_ok=True)  # noqa: PTH103
    status = os.lstat(path)
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
        raise PermissionError(f"{path} is not a folder of this user")
    if stat.S_IMODE(status.st_mode) != 0o700:
        os.chmod(path, 0o700)  # noqa: PTH101
    return path


def name(connection: str) -> str:
    """Return the file name of a connection, without suffix: the first 16 hexadecimal digits of the hash."""
    with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:  # noqa: PTH123
        boot_id = file.read().strip()
    network_namespace = os.stat("/proc/self/ns/net").st_ino  # noqa: PTH116
    return hashlib.sha256(f"{boot_id} {network_namespace} {connection}".encode()).hexdigest()[:16]


@contextmanager
def address(connection: str) -> Iterator[str]:
    """Yield an address of a connection's socket that is short even if the path of the home folder is long."""
    descriptor = os.open(folder(), os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{name(connection)}.sock"
    finally:
        os.close(descriptor)


def lock(connection: str) -> int | None:
    """Lock the lock file of a connection; return its descriptor, or None if another server holds the lock.

    Raises:
        OSError: The file cannot be created.
    """
    path = f"{folder()}/{name(connection)}.lock"
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        try:
            # A server that ends removes its lock file. The lock is valid only if the path still leads to this file.
            if os.fstat(descriptor).st_ino == os.stat(path).st_ino:  # noqa: PTH116
                return descriptor
        except FileNotFoundError:
            pass  # the previous owner of the lock has removed the file
        os.close(descriptor)


def remove(connection: str) -> None:
    """Remove the files of a connection. The caller must hold its lock."""
    for suffix in ("sock", "log", "lock"):
        with suppress(FileNotFoundError):
            os.unlink(f"{folder()}/{name(connection)}.{suffix}")  # noqa: PTH108


def peer_credentials(stream: socket.socket) -> tuple[int, int]:
    """Return the process id and the user id of the other end of a Unix-domain socket."""
    packed = stream.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(packed)
    return pid, uid
