"""OpenSSH configuration with which ssh, scp, sftp, rsync and Ansible reach the robots of a lab."""

import os
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fieldkit.lab.folder import LabFolder
from fieldkit.lab.protocol import Login

_CONNECT: Final = Path(__file__).with_name("connect.py")


def write(folder: LabFolder, login: Login) -> None:
    """Write key, host keys and configuration into the lab's folder, readable for this user only."""
    hosts = "".join(f"{name} {key}\n" for name, key in login.host_keys.items())
    for path, text in (
        (folder.key, login.private_key),
        (folder.known_hosts, hosts),
        (folder.ssh_config, config(folder, login.user, login.host_keys)),
    ):
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)


def config(folder: LabFolder, user: str, robots: Iterable[str]) -> str:
    """Return a configuration for `ssh -F`: robots by name, with pinned host keys, over Unix sockets."""
    # -I ignores modules in the current directory and Python's environment variables.
    words = (sys.executable, "-I", str(_CONNECT), str(folder.socket))
    command = shlex.join(words).replace("%", "%%")
    return f"""\
Host {" ".join(robots)}
    User {user}
    IdentityFile "{folder.key}"
    IdentitiesOnly yes
    IdentityAgent none
    UserKnownHostsFile "{folder.known_hosts}"
    GlobalKnownHostsFile none
    StrictHostKeyChecking yes
    UpdateHostKeys no
    ProxyCommand {command} %n
    ProxyUseFdpass yes
"""
