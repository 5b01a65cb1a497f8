"""The runtime folder of a directory's lab: socket, key, ssh configuration and log; only its user has access.

Its parent is the base folder of runtime files (`runtime.base_folder`), which is in memory on most systems.
"""

import hashlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from fieldkit.core import runtime


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
    def lock_name(self) -> str:
        """Name of the lock that only one process can hold, see `runtime.hold_lock`."""
        return f"lab-{self.path.name}"


def of_directory(directory: Path) -> LabFolder:
    """Return the folder of the lab of a directory, without creating it.

    Raises:
        ConfigurationError: The path exists, but is not a folder to which only this user has access.
    """
    digest = hashlib.sha256(os.fsencode(directory.resolve())).hexdigest()[:16]
    path = runtime.base_folder() / f"fieldkit-{os.geteuid()}-{digest}"
    if not _is_private_or_absent(path):
        raise runtime.not_private_error(path)
    return LabFolder(path)


def make(folder: LabFolder) -> None:
    """Create the folder for this user only, and delete files that a killed lab left there.

    Raises:
        ConfigurationError: The path exists and cannot be removed, for example because another user owns it.
    """
    remove(folder)
    try:
        folder.path.mkdir(mode=0o700)
    except FileExistsError as error:
        raise runtime.not_private_error(folder.path) from error


def remove(folder: LabFolder) -> None:
    """Remove the folder if it exists; errors are ignored."""
    shutil.rmtree(folder.path, ignore_errors=True)


def _is_private_or_absent(path: Path) -> bool:
    try:
        return runtime.is_private(path.lstat())
    except FileNotFoundError:
        return True
