"""The folder of a directory's lab, with what others need to find it: in memory, and closed to other users."""

import hashlib
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from fieldkit.core import runtime


@dataclass(frozen=True)
class LabFolder:
    """The folder of one lab; its path is short, as the name of a Unix socket must be.

    Attributes:
        path: The folder, which is there while the lab is up.
    """

    path: Path

    @property
    def socket(self) -> Path:
        """Unix socket of the lab's process."""
        return self.path / "socket"

    @property
    def key(self) -> Path:
        """Private key that logs in on every robot."""
        return self.path / "key"

    @property
    def known_hosts(self) -> Path:
        """Host keys of the robots."""
        return self.path / "known_hosts"

    @property
    def ssh_config(self) -> Path:
        """What `ssh -F` takes."""
        return self.path / "ssh_config"

    @property
    def log(self) -> Path:
        """What the lab's process says in the background."""
        return self.path / "log"

    @property
    def claim(self) -> str:
        """Name that only one process can hold, see `runtime.held`."""
        return f"lab-{self.path.name}"


def of_directory(directory: Path) -> LabFolder:
    """Return the folder of the lab of a directory; nothing is made.

    Raises:
        ConfigurationError: Somebody else owns the place.
    """
    digest = hashlib.sha256(os.fsencode(directory.resolve())).hexdigest()[:16]
    path = runtime.base_folder() / f"fieldkit-{os.geteuid()}-{digest}"
    if not _is_own(path):
        raise runtime.not_private(path)
    return LabFolder(path)


def make(folder: LabFolder) -> None:
    """Make the folder, closed to other users; what a lab that was killed left there is gone.

    Raises:
        ConfigurationError: Somebody else owns the place.
    """
    remove(folder)
    try:
        folder.path.mkdir(mode=0o700)
    except FileExistsError as error:
        raise runtime.not_private(folder.path) from error


def remove(folder: LabFolder) -> None:
    """Remove the folder, if there is one."""
    shutil.rmtree(folder.path, ignore_errors=True)


def _is_own(path: Path) -> bool:
    """Return whether nobody else can change what lies there, if anything does."""
    try:
        return runtime.is_private(path.lstat())
    except FileNotFoundError:
        return True
