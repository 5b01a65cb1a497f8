"""Paths of programs that procedures name, and the search for their files.

When a procedure is read, a file that it names is searched first in the folder of the procedure file, then in
the lab's folder (the current directory). `trial.yaml` stores its path and its hash.
"""

import hashlib
import os
import stat
from pathlib import Path, PurePosixPath
from typing import Annotated

from fieldkit.config import schema
from fieldkit.config.program_files import MAX_BYTES, LabProgram, resolve
from fieldkit.config.schema import BeforeValidator
from fieldkit.core import files
from fieldkit.core.errors import shell_command
from fieldkit.core.units import format_bytes


def _to_record(value: object) -> object:
    """Return the record of the program at a path. A value that is a record already is returned unchanged."""
    if isinstance(value, dict | LabProgram):
        return value
    if not isinstance(value, str):
        raise schema.validation_error("the path of a file is needed here, for example tools/probe.py")
    _require_valid_name(value)
    search_folders = list(dict.fromkeys((schema.folder(), Path())))
    for folder in search_folders:
        if os.path.lexists(path := folder / value):
            return _record(value, path, folder)
    folders = " and ".join(f"{shell_command(folder.absolute())}" for folder in search_folders)
    raise schema.validation_error(f"there is no file {value!r}; searched in {folders}")


def _require_valid_name(name: str) -> None:
    path = PurePosixPath(name)
    if not path.name or path.is_absolute() or ".." in path.parts:
        raise schema.validation_error(
            f"{name!r} is not the relative path of a file in the folder of the procedure or of the lab (without ..)"
        )
    if not path.name.isprintable():
        raise schema.validation_error(f"{name!r} has a character in its name that cannot be printed")


def _record(name: str, path: Path, folder: Path) -> dict[str, object]:
    """Return the record of a file that was found in `folder`.

    If the file is a link, its target must be in the lab's folder; if `folder` is outside of the lab's folder, the
    target must be in `folder`.
    """
    lab, folder = Path.cwd().resolve(), folder.resolve()
    allowed_folder = lab if folder.is_relative_to(lab) else folder
    try:
        target = resolve(path)
        status = target.stat()
        if not target.is_relative_to(allowed_folder):
            raise schema.validation_error(
                f"{name!r} is a link to a file outside of {allowed_folder}; copy the file there"
            )
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
