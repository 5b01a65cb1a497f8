"""Where the lab of a directory keeps what others need to find it: in memory, and closed to other users."""

import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from fieldkit.errors import ConfigurationError


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
        """Abstract name of a socket that only one process can have."""
        return f"\0fieldkit lab {os.geteuid()} {self.path.name}"


def of_directory(directory: Path) -> LabFolder:
    """Return the folder of the lab of a directory; nothing is made.

    Raises:
        ConfigurationError: Somebody else owns the place.
    """
    digest = hashlib.sha256(os.fsencode(directory.resolve())).hexdigest()[:16]
    return LabFolder(_root() / f"lab-{digest}")


def _root() -> Path:
    """Return this user's folder for what lives in memory, or one like it."""
    user = os.geteuid()
    for folder in filter(None, (os.environ.get("XDG_RUNTIME_DIR"), f"/run/user/{user}")):
        path = Path(folder)
        # After sudo the variable still names another user's.
        if path.is_dir() and path.stat().st_uid == user:
            return path / "fieldkit"
    path = Path(tempfile.gettempdir(), f"fieldkit-{user}")
    path.mkdir(mode=0o700, exist_ok=True)
    status = path.lstat()
    if path.is_symlink() or status.st_uid != user or status.st_mode & 0o077:
        raise ConfigurationError(
            "is not this user's alone", where=str(path), remedy=f"remove it, or set XDG_RUNTIME_DIR: ls -ld {path}"
        )
    return path
