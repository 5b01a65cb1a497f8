"""Control connections to the robots of a directory's lab, for processes other than the lab."""

import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from fieldkit.core.errors import ConfigurationError
from fieldkit.lab.connect import TIMEOUT_S
from fieldkit.lab.folder import LabFolder
from fieldkit.remote.ssh import SshShell


@contextmanager
def open_shells(folder: LabFolder) -> Iterator[dict[str, SshShell]]:
    """Yield the connections to the robots by name; empty if no lab is up. A connection is opened at its first use.

    Raises:
        ConfigurationError: The lab's folder is incomplete.
    """
    shells: dict[str, SshShell] = {}
    try:
        if folder.ssh_config.is_file():
            user = re.search(r"^    User (\S+)$", folder.ssh_config.read_text(encoding="utf-8"), re.MULTILINE)
            if user is None:
                raise ConfigurationError(
                    "this file has no line User", where=str(folder.ssh_config), remedy="fieldkit lab down"
                )
            key = folder.key.read_text(encoding="utf-8")
            for line in folder.known_hosts.read_text(encoding="utf-8").splitlines():
                name, _, host_key = line.partition(" ")
                connect = partial(_stream, folder, name)
                shells[name] = SshShell(name, connect=connect, user=user[1], host_key=host_key, private_key=key)
        yield shells
    finally:
        for shell in shells.values():
            shell.close()


def _stream(folder: LabFolder, robot: str, timeout_s: float) -> socket.socket:
    """Return a stream to a robot's SSH server, from the process of the lab.

    Raises:
        OSError: The lab does not answer, or has no such robot.
    """
    with socket.socket(socket.AF_UNIX) as lab:
        lab.settimeout(min(timeout_s, TIMEOUT_S))
        lab.connect(str(folder.socket))
        lab.sendall(f"connect {robot}\n".encode())
        answer, descriptors, _, _ = socket.recv_fds(lab, 4096, 1)
    if not descriptors:
        raise OSError(answer.decode(errors="replace"))
    return socket.socket(fileno=descriptors[0])
