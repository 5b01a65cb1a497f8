"""Write the site file: a commented one to begin with, and a host key pinned in one that people wrote."""

from importlib import resources
from pathlib import Path
from typing import Any, Final

from fieldkit.config import documents
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, typed

_TEMPLATE: Final = "site_template.yaml"
_KEY: Final = "host_key"


def create(path: Path) -> None:
    """Write a commented site file.

    Raises:
        ConfigurationError: There is one, or the folder cannot be written.
    """
    text = resources.files("fieldkit.config").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConfigurationError(
            "there is a file of this name, which is not overwritten",
            where=str(path),
            remedy=f"fieldkit init --out other.yaml; or {typed('mv', path, f'{path}.old')}",
        ) from error
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(path), remedy="choose another --out"
        ) from error


def pin(path: Path, robot: str, host_key: str) -> None:
    """Set the `host_key` of a robot; every other character of the file stays. A crash leaves the old file or the new.

    Raises:
        ConfigurationError: The file cannot be read or written, or is written in a way that cannot be edited.
    """
    old = documents.read(path)
    try:
        path = path.resolve()  # a link to a file in a repository stays a link
        text = path.read_bytes().decode()
        new = _with_key(text, robot, host_key)
        if not _holds(new, old.data, robot, host_key):
            raise ConfigurationError(
                f"{_KEY} of {robot!r} cannot be written into the way this file is written",
                where=old.where(("robots", robot)),
                remedy=f"write {_KEY}: {host_key}",
            )
        files.write(path, new.encode())
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(path), remedy=typed("ls", "-ld", path.parent, path)
        ) from error


def _with_key(text: str, robot: str, host_key: str) -> str:
    """Return the file with the key, or as it is where it cannot be edited."""
    try:
        return documents.with_value(text, ("robots", robot, _KEY), host_key)
    except ValueError:
        return text


def _holds(text: str, old: Any, robot: str, host_key: str) -> bool:  # noqa: ANN401 (a plain tree)
    """Return whether `text` says what `old` says, and the key."""
    wanted = {**old, "robots": {**old["robots"], robot: {**old["robots"][robot], _KEY: host_key}}}
    try:
        return bool(documents.parse(text, source="").data == wanted)
    except ConfigurationError:
        return False
