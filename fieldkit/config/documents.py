"""YAML documents: read, with the line that each value stands in; written; and edited, one value and nothing else.

The only module that imports pyyaml, which reads and writes, and ruamel.yaml, which tells where in a text a value is.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import yaml

from fieldkit.core.errors import ConfigurationError

if TYPE_CHECKING:
    from ruamel.yaml.nodes import MappingNode, Node

_MAX_BYTES: Final = 1 << 20

Location = tuple[str | int, ...]
"""Keys and indices that lead from the root of a document to a value."""


class _Loader(yaml.SafeLoader):
    """SafeLoader with the scalars of YAML 1.2: only true and false are booleans, and `1:30` or `on` stay text."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Refuse aliases: they hide what a file says, and nested ones grow without bound."""
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem="aliases (*name) are not supported",
                problem_mark=self.peek_event().start_mark,  # type: ignore[no-untyped-call]
            )
        return super().compose_node(parent, index)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes what either version of YAML takes for a number: a hash may be `6372e70369712148`.

    It escapes line ends of YAML 1.1 beside the line feed, which it would write as they are and read as spaces.
    """

    def represent_text(self, text: str) -> yaml.Node:
        """Return a text as a node."""
        style = '"' if _OTHER_LINE_ENDS.intersection(text) else None
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_OTHER_LINE_ENDS: Final = frozenset("\r\N{NEXT LINE}\N{LINE SEPARATOR}\N{PARAGRAPH SEPARATOR}")
_Dumper.add_representer(str, _Dumper.represent_text)


_CORE_SCHEMA: Final = {
    "null": (r"~|null|", ["~", "n", ""]),
    "bool": (r"true|false", ["t", "f"]),
    "int": (r"[-+]?[0-9]+", list("-+0123456789")),
    "float": (
        r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+",
        list("-+.0123456789"),
    ),
}
_Loader.yaml_implicit_resolvers = {}
for _tag, (_pattern, _first) in _CORE_SCHEMA.items():
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})\\Z"), _first)


@dataclass(frozen=True)
class Document:
    """A YAML document that remembers where each value stands.

    Attributes:
        data: Plain values: dict, list, str, int, float, bool, None.
        source: The file's name, for messages.
        lines: Line (from 1) per location, a tuple of keys and indices; the root is `()`.
        place: Location of this document in the file, where it is a part of one.
    """

    data: Any
    source: str
    lines: dict[Location, int]
    place: Location = ()

    def where(self, location: Location) -> str:
        """Return `file:line` of the innermost part of `location` that stands in the file."""
        known = tuple(part for part in location if not (isinstance(part, str) and part.startswith("tagged-")))
        while known and known not in self.lines:
            known = known[:-1]
        return f"{self.source}:{self.lines.get(known, 1)}"

    def part(self, *location: str | int) -> "Document":
        """Return the value at `location` as a document of its own, lines kept."""
        data = self.data
        for key in location:
            data = data[key]
        size = len(location)
        lines = {place[size:]: line for place, line in self.lines.items() if place[:size] == location}
        return Document(data=data, source=self.source, lines=lines, place=(*self.place, *location))


def read(path: Path) -> Document:
    """Read one YAML file; errors as `parse`, and a file that cannot be read."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigurationError("the file is larger than 1 MiB", where=str(path), remedy="is it the right file?")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"cannot be read: {getattr(error, 'strerror', None) or error}",
            where=str(path),
            remedy="check its name, rights and encoding (UTF-8)",
        ) from error
    return parse(text, source=str(path))


def parse(text: str, *, source: str) -> Document:
    """Return the one YAML document in `text`.

    Raises:
        ConfigurationError: Not YAML, an alias, a duplicate key, or a key that is no text.
    """
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        lines: dict[Location, int] = {(): 1}
        data = None if node is None else _plain(loader, node, (), lines)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{source}:{mark.line + 1}" if mark else source
        raise ConfigurationError(
            f"not valid YAML: {getattr(error, 'problem', error)}",
            where=where,
            remedy="mend the line named above",
        ) from error
    finally:
        loader.dispose()
    return Document(data=data, source=source, lines=lines)


def _plain(loader: _Loader, node: yaml.Node, place: Location, lines: dict[Location, int]) -> Any:  # noqa: ANN401
    if isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[(*place, index)] = item.start_mark.line + 1
        return [_plain(loader, item, (*place, index), lines) for index, item in enumerate(node.value)]
    if isinstance(node, yaml.MappingNode):
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = key_node.value
            problem = None
            if not isinstance(key_node, yaml.ScalarNode):
                problem = "a key must be text"
            elif key in mapping:
                problem = f"duplicate key {key!r}"
            if problem:
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key_node.start_mark)
            lines[(*place, key)] = key_node.start_mark.line + 1
            mapping[key] = _plain(loader, value_node, (*place, key), lines)
        return mapping
    return loader.construct_object(node)


def to_text(data: object) -> str:
    """Return plain values as YAML that `parse` reads back as the same ones."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def with_value(text: str, location: tuple[str, ...], value: str) -> str:
    """Return a document with a key of one of its mappings set to a plain text; every other character stays.

    A key that is new goes to the end of its mapping. Whether the result says what it should, the caller checks: not
    every way to write YAML can be edited so.

    Args:
        text: The document.
        location: Keys that lead to the value; the mapping that holds the last is there and not empty.
        value: Written as it is, without quotes.
    """
    # Only who edits a file pays for this import.
    from ruamel.yaml import YAML  # noqa: PLC0415
    from ruamel.yaml.nodes import MappingNode  # noqa: PLC0415

    *parents, key = location
    node = YAML(typ="rt", pure=True).compose(text)
    assert isinstance(node, MappingNode)
    for parent in parents:
        node = _value(node, parent)
        assert isinstance(node, MappingNode)
    old = _value(node, key)
    if old is not None:
        begin, end = old.start_mark.index, old.end_mark.index
        return f"{text[:begin]}{'' if begin < end else ' '}{value}{text[end:]}"
    last_key, last_value = node.value[-1]
    at: int = last_value.end_mark.index
    if node.flow_style:
        return f"{text[:at]}, {key}: {value}{text[at:]}"
    line_end = re.compile(r"\r?\n|\Z").search(text, at)
    assert line_end is not None
    at = line_end.start()
    return f"{text[:at]}{line_end[0] or os.linesep}{' ' * last_key.start_mark.column}{key}: {value}{text[at:]}"


def _value(mapping: "MappingNode", key: str) -> "Node | None":
    """Return the value of a key, None where the mapping has none."""
    return next((value for name, value in mapping.value if name.value == key), None)
