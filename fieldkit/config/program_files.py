"""Programs of a lab that a procedure copies to robots: files with their SHA-256.

A procedure names a file. When the procedure is read, the file is searched first in the folder of the procedure file,
then in the lab's folder (the current directory). `trial.yaml` stores its path and its hash.
"""

import hashlib
import os
import stat
from pathlib import Path, PurePosixPath
from typing import Annotated, Final

from fieldkit.config import schema
from fieldkit.config.schema import BeforeValidator, Bool, Field, Int, Strict
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.units import format_bytes

MAX_BYTES: Final = 8 << 20
"""Largest size of a program.

It is sent over the control connection before each attempt, perhaps over a slow radio.
"""


class LabProgram(Strict):
    """A program of the lab, at the time when its procedure was read.

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
            content = files.read(_resolve(Path(self.file)), MAX_BYTES)
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


def _to_record(value: object) -> object:
    """Return the record of the program with a given path; a record is returned unchanged."""
    if isinstance(value, dict | LabProgram):
        return value
    if not isinstance(value, str):
        raise schema.validation_error("the path of a file is needed here, tools/probe.py for example")
    _require_valid_name(value)
    searched = list(dict.fromkeys((schema.folder(), Path())))
    for folder in searched:
        if os.path.lexists(path := folder / value):
            return _record(value, path, folder)
    folders = " and ".join(f"{shell_command(folder.absolute())}" for folder in searched)
    raise schema.validation_error(f"there is no file {value!r}; searched in {folders}")


def _resolve(path: Path) -> Path:
    """Return a path with links resolved; raises OSError if it does not exist."""
    return Path(os.path.realpath(path, strict=True))


def _require_valid_name(name: str) -> None:
    path = PurePosixPath(name)
    if not path.name or path.is_absolute() or ".." in path.parts:
        raise schema.validation_error(
            f"{name!r} is not the relative path of a file in the folder of the procedure or of the lab (without ..)"
        )
    if not path.name.isprintable():
        raise schema.validation_error(f"{name!r} has a character in its name that cannot be printed")


def _record(name: str, path: Path, folder: Path) -> dict[str, object]:
    lab, folder = Path.cwd().resolve(), folder.resolve()
    inside = lab if folder.is_relative_to(lab) else folder
    try:
        target = _resolve(path)
        status = target.stat()
        if not target.is_relative_to(inside):
            raise schema.validation_error(f"{name!r} is a link to a file outside of {inside}; copy the file there")
        if target.is_dir():
            raise schema.validation_error(f"{name!r} is a folder; name one file")
        if status.st_size > MAX_BYTES:
            sizes = f"{format_bytes(status.st_size)}, more than {format_bytes(MAX_BYTES)}"
            raise schema.validation_error(f"{name!r} has {sizes}; install it on the robot")
        content = files.read(target, MAX_BYTES)
    except OSError as error:
        raise schema.validation_error(f"{name!r} cannot be read: {error.strerror}") from None
    return {
        "file": str(target.relative_to(lab) if target.is_relative_to(lab) else target),
        "sha256": hashlib.sha256(content).hexdigest(),
        "size_bytes": len(content),
        "executable": bool(status.st_mode & stat.S_IXUSR),
    }


NamedProgram = Annotated[LabProgram, BeforeValidator(_to_record)]
"""A program: its path, `tools/probe.py`, in a procedure, or its record in `trial.yaml`."""
