"""Where a link server is found: a Unix-domain socket and a lock file in a private folder.

Their name stands for the connection in this network namespace since this boot, so that neither a home folder that
several robots share nor a container mixes connections up.
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
    """Return the folder of sockets, which only this user can enter.

    Raises:
        OSError: It cannot be made, or belongs to another user.
    """
    path = os.path.expanduser(os.path.join(*_FOLDER))  # noqa: PTH111, PTH118 (Python 3.8)
    os.makedirs(path, mode=0o700, exist_ok=True)  # noqa: PTH103
    found = os.lstat(path)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
        raise PermissionError(f"{path} is not a folder of this user")
    if stat.S_IMODE(found.st_mode) != 0o700:
        os.chmod(path, 0o700)  # noqa: PTH101
    return path


def name(connection: str) -> str:
    """Return the name of the files of a connection, without suffix."""
    with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:  # noqa: PTH123
        boot = file.read().strip()
    network = os.stat("/proc/self/ns/net").st_ino  # noqa: PTH116
    return hashlib.sha256(f"{boot} {network} {connection}".encode()).hexdigest()[:16]


@contextmanager
def address(connection: str) -> Iterator[str]:
    """Yield the address of a connection's socket, which is short however long the path of the home folder is."""
    descriptor = os.open(folder(), os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{name(connection)}.sock"
    finally:
        os.close(descriptor)


def lock(connection: str) -> int | None:
    """Return the locked lock file of a connection; None where another server has it.

    Raises:
        OSError: It cannot be made.
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
            if os.fstat(descriptor).st_ino == os.stat(path).st_ino:  # noqa: PTH116
                return descriptor
        except FileNotFoundError:
            pass  # its former owner has removed it
        os.close(descriptor)


def remove(connection: str) -> None:
    """Remove the files of a connection; only the owner of its lock may."""
    for suffix in ("sock", "log", "lock"):
        with suppress(FileNotFoundError):
            os.unlink(f"{folder()}/{name(connection)}.{suffix}")  # noqa: PTH108


def peer(stream: socket.socket) -> tuple[int, int]:
    """Return the process id and the user id of the other end of a Unix-domain socket."""
    packed = stream.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(packed)
    return pid, uid
