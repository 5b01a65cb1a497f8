"""Programs of a lab that a procedure copies to robots, and their records with SHA-256 in `trial.yaml`."""

import hashlib
import os
from pathlib import Path, PurePosixPath
from typing import Annotated, Final

from fieldkit.config.schema import Bool, Field, Int, Strict
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError

MAX_BYTES: Final = 8 << 20
"""Maximum size of a program, which is sent before each attempt over the control connection, perhaps a slow radio."""


class LabProgram(Strict):
    """The record of a program of the lab, made when its procedure was read.

    Attributes:
        file: Its path, written by fieldkit into `trial.yaml`.
        sha256: SHA-256 of its content, which is checked for each attempt.
        size_bytes: Its size in bytes.
        executable: True if the copy is executable.
    """

    file: Annotated[str, Field(pattern=r"^[^\x00]+$")]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    size_bytes: Annotated[Int, Field(ge=0, le=MAX_BYTES)]
    executable: Bool

    @property
    def name(self) -> str:
        """The name of the file without its folders."""
        return PurePosixPath(self.file).name

    def content(self) -> bytes:
        """Return the content after verifying its hash.

        Raises:
            ConfigurationError: The file is missing, cannot be read, or has changed.
        """
        remedy = f"restore it (SHA-256 {self.sha256}), or start a new trial"
        try:
            content = files.read(resolve(Path(self.file)), MAX_BYTES)
        except OSError as error:
            raise ConfigurationError(
                f"the program that the trial copies to robots cannot be read: {error.strerror}",
                where=self.file,
                remedy=f"change to the folder of the lab (cd); {remedy}",
            ) from error
        if hashlib.sha256(content).hexdigest() != self.sha256:
            raise ConfigurationError(
                "the program has changed since the procedure was read", where=self.file, remedy=remedy
            )
        return content


def resolve(path: Path) -> Path:
    """Return a path with links resolved; raises OSError if it does not exist."""
    return Path(os.path.realpath(path, strict=True))
