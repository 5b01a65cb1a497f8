"""Creation and changes of site files: a commented template, and the host keys of robots."""

import os
import re
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
    document = documents.read(path)
    try:
        path = path.resolve()  # a link to a file in a repository remains a link
        text = path.read_bytes().decode()
        new_text = _with_key(text, robot, host_key)
        if not _is_pinned(new_text, document.data, robot, host_key):
            raise ConfigurationError(
                f"{_KEY} of {robot!r} cannot be inserted, because of the layout of this file",
                where=document.where(("robots", robot)),
                remedy=f"add it in an editor: {_KEY}: {host_key}",
            )
        files.write(path, new_text.encode())
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}",
            where=str(path),
            remedy=shell_command("ls", "-ld", path.parent, path),
        ) from error


def _with_key(text: str, robot: str, host_key: str) -> str:
    """Return the text with the key, or unchanged if it cannot be edited."""
    try:
        return _with_value(text, ("robots", robot, _KEY), host_key)
    except ValueError:
        return text


def _is_pinned(text: str, data: Any, robot: str, host_key: str) -> bool:  # noqa: ANN401 (plain values of YAML)
    """Return True if `text` has the values of `data`, and the host key."""
    expected = {**data, "robots": {**data["robots"], robot: {**data["robots"][robot], _KEY: host_key}}}
    try:
        return bool(documents.parse(text, source="").data == expected)
    except ConfigurationError:
        return False


def _with_value(text: str, location: tuple[str, ...], value: str) -> str:
    """Return a document with one key of a mapping set to a plain text; every other character is unchanged.

    A new key is added at the end of its mapping. The caller must check the result, because not every layout of YAML
    can be edited in this way.

    Args:
        text: The document.
        location: Keys that lead to the value; the mapping that contains the last key exists and is not empty.
        value: Written without quotes.

    Raises:
        ValueError: The document is not valid YAML.
    """
    *parents, key = location
    node = documents.compose(text)
    for parent in parents:
        node = _value(node, parent)
    old_node = _value(node, key)
    if old_node is not None:
        start, end = old_node.start_mark.index, old_node.end_mark.index
        return f"{text[:start]}{'' if start < end else ' '}{value}{text[end:]}"
    assert isinstance(node, documents.MappingNode)
    insert_at = _end_index(node.value[-1][1])
    if node.flow_style:
        return f"{text[:insert_at]}, {key}: {value}{text[insert_at:]}"
    line_end = re.compile(r"\r?\n|\Z").search(text, insert_at)
    assert line_end is not None
    insert_at = line_end.start()
    column = node.value[-1][0].start_mark.column
    return f"{text[:insert_at]}{line_end[0] or os.linesep}{' ' * column}{key}: {value}{text[insert_at:]}"


def _value(mapping: documents.Node | None, key: str) -> documents.Node | None:
    """Return the value of a key, or None if the mapping does not have it."""
    assert isinstance(mapping, documents.MappingNode)
    return next((value for name, value in mapping.value if name.value == key), None)


def _end_index(node: documents.Node) -> int:
    """Return the index after a node. For a block collection, the end mark of PyYAML is the start of the next node."""
    while isinstance(node, documents.CollectionNode) and not node.flow_style:
        last = node.value[-1]
        node = last[1] if isinstance(node, documents.MappingNode) else last
    return node.end_mark.index
