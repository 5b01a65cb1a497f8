"""The runtime folder of a directory's lab: socket, key, ssh configuration and log; in memory, for one user only."""

import hashlib
import os
import shlex
import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core import runtime
from fieldkit.lab.protocol import Login


@dataclass(frozen=True)
class LabFolder:
    """The folder of one lab; its path is short because the path of a Unix socket is limited to 107 bytes.

    Attributes:
        path: The folder, which exists while the lab is up.
    """

    path: Path

    @property
    def socket(self) -> Path:
        """Unix socket of the lab's process."""
        return self.path / "socket"

    @property
    def key(self) -> Path:
        """Private key for the login on every robot."""
        return self.path / "key"

    @property
    def known_hosts(self) -> Path:
        """Host keys of the robots."""
        return self.path / "known_hosts"

    @property
    def ssh_config(self) -> Path:
        """Configuration file for `ssh -F`."""
        return self.path / "ssh_config"

    @property
    def log(self) -> Path:
        """Output of the lab's process while it runs in the background."""
        return self.path / "log"

    @property
    def claim(self) -> str:
        """Name of the lock that only one process can hold, see `runtime.held`."""
        return f"lab-{self.path.name}"


def of_directory(directory: Path) -> LabFolder:
    """Return the folder of the lab of a directory, without creating it.

    Raises:
        ConfigurationError: Another user owns the path.
    """
    digest = hashlib.sha256(os.fsencode(directory.resolve())).hexdigest()[:16]
    path = runtime.base_folder() / f"fieldkit-{os.geteuid()}-{digest}"
    if not _is_private_or_absent(path):
        raise runtime.not_private(path)
    return LabFolder(path)


def make(folder: LabFolder) -> None:
    """Create the folder for this user only, and delete files that a killed lab left there.

    Raises:
        ConfigurationError: Another user owns the path.
    """
    remove(folder)
    try:
        folder.path.mkdir(mode=0o700)
    except FileExistsError as error:
        raise runtime.not_private(folder.path) from error


def remove(folder: LabFolder) -> None:
    """Remove the folder if it exists."""
    shutil.rmtree(folder.path, ignore_errors=True)


def _is_private_or_absent(path: Path) -> bool:
    try:
        return runtime.is_private(path.lstat())
    except FileNotFoundError:
        return True


_CONNECT: Final = Path(__file__).with_name("connect.py")


def write_ssh_config(folder: LabFolder, login: Login) -> None:
    """Write key, host keys and configuration into the lab's folder, readable for this user only."""
    hosts = "".join(f"{name} {key}\n" for name, key in login.host_keys.items())
    for path, text in (
        (folder.key, login.private_key),
        (folder.known_hosts, hosts),
        (folder.ssh_config, ssh_config(folder, login.user, login.host_keys)),
    ):
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(text)


def ssh_config(folder: LabFolder, user: str, robots: Iterable[str]) -> str:
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
