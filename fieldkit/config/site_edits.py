"""Creation and changes of site files: a commented template, and the host keys of robots."""

from importlib import resources
from pathlib import Path
from typing import Any, Final

from fieldkit.config import documents
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, shell_command

_TEMPLATE: Final = "site_template.yaml"
_KEY: Final = "host_key"


def create_site_file(path: Path) -> None:
    """Write a commented site file.

    Raises:
        ConfigurationError: The file exists, or the folder cannot be written.
    """
    text = resources.files("fieldkit.config").joinpath(_TEMPLATE).read_text(encoding="utf-8")
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConfigurationError(
            "this file exists and is not overwritten",
            where=str(path),
            remedy=f"fieldkit init --out other.yaml; or {shell_command('mv', path, f'{path}.old')}",
        ) from error
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(path), remedy="choose another --out"
        ) from error


def pin_host_key(path: Path, robot: str, host_key: str) -> None:
    """Set the `host_key` of a robot; every other character of the file is unchanged. The write is atomic.

    Raises:
        ConfigurationError: The file cannot be read or written, or its layout does not allow the edit.
    """
    old = documents.read(path)
    try:
        path = path.resolve()  # a link to a file in a repository remains a link
        text = path.read_bytes().decode()
        new = _with_key(text, robot, host_key)
        if not _is_pinned(new, old.data, robot, host_key):
            raise ConfigurationError(
                f"{_KEY} of {robot!r} cannot be inserted, because of the layout of this file",
                where=old.where(("robots", robot)),
                remedy=f"add it in an editor: {_KEY}: {host_key}",
            )
        files.write(path, new.encode())
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}",
            where=str(path),
            remedy=shell_command("ls", "-ld", path.parent, path),
        ) from error


def _with_key(text: str, robot: str, host_key: str) -> str:
    """Return the file with the key, or unchanged if it cannot be edited."""
    try:
        return documents.with_value(text, ("robots", robot, _KEY), host_key)
    except ValueError:
        return text


def _is_pinned(text: str, old: Any, robot: str, host_key: str) -> bool:  # noqa: ANN401 (a plain tree)
    """Return True if `text` has the values of `old` and the key."""
    expected = {**old, "robots": {**old["robots"], robot: {**old["robots"][robot], _KEY: host_key}}}
    try:
        return bool(documents.parse(text, source="").data == expected)
    except ConfigurationError:
        return False
