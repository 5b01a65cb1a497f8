"""Read YAML documents with the line of each value, write values as YAML, and return syntax trees for edits.

This is the only module that imports PyYAML.
"""

import codecs
import math
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.parser import Parser
from yaml.reader import Reader
from yaml.resolver import Resolver
from yaml.scanner import Scanner

from fieldkit.core.errors import ConfigurationError, shell_command

_MAX_BYTES: Final = 1 << 20
_MAX_DEPTH: Final = 50
_MAX_INT: Final = 2**63 - 1
_MAX_DIGITS: Final = 100
"""Maximum number of characters of a number. The time of Python's conversion grows with the square of the length."""
_INVALID_CHARACTERS: Final = re.compile("[\0\ud800-\udfff]")
"""Characters that an escape sequence can produce, but that no file name and no argument can contain: NUL, and
surrogates, which UTF-8 cannot encode."""

Node = yaml.Node
"""A value in the syntax tree of a document."""
MappingNode = yaml.MappingNode
CollectionNode = yaml.CollectionNode

Location = tuple[str | int, ...]
"""Keys and indices from the root of a document to a value."""


class _Loader(Reader, Scanner, Parser, Composer, SafeConstructor, Resolver):
    """Reads YAML 1.2: only true and false are booleans, `1:30` and `on` are text, 010 is 10.

    Aliases, tags, deep nesting and numbers that overflow are errors, reported with their line.
    """

    def __init__(self, text: str) -> None:
        Reader.__init__(self, text)
        Scanner.__init__(self)
        Parser.__init__(self)
        Composer.__init__(self)
        SafeConstructor.__init__(self)
        Resolver.__init__(self)
        self._depth = 0
        self._text = text

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Return a node, as PyYAML does; raise an error for unsupported YAML."""
        event = self.peek_event()  # type: ignore[no-untyped-call]
        # Aliases make a file hard to read, and nested aliases can expand without bound.
        if isinstance(event, yaml.events.AliasEvent):
            raise _marked_error("aliases (*name) are not supported", event)
        # A tag would make PyYAML convert the value by the rules of YAML 1.1.
        if getattr(event, "tag", None) is not None:
            raise _marked_error("tags (!name) are not supported; put text that begins with ! in quotes", event)
        # PyYAML recurses at each level.
        if self._depth >= _MAX_DEPTH:
            raise _marked_error(f"nested more than {_MAX_DEPTH} deep", event)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.ScalarNode) and _INVALID_CHARACTERS.search(node.value):
            raise _marked_error(
                "this text has a character that is not supported (\\0, or half of a surrogate pair)", event
            )
        if isinstance(node, yaml.ScalarNode) and isinstance(parent, yaml.SequenceNode):
            self._require_one_item(node)
        return node

    def _require_one_item(self, node: yaml.ScalarNode) -> None:
        """Raise an error if an item continues with a line that begins with a dash, which YAML adds to the item."""
        if not node.style:
            lines = self._text.splitlines()[node.start_mark.line : node.end_mark.line + 1]
            for number, line in enumerate(lines[1:], start=node.start_mark.line + 2):
                if line.lstrip().startswith("- "):
                    raise _JoinedItemError(number)

    def checked_int(self, node: yaml.ScalarNode) -> int:
        """Return a whole number. Leading zeros have no effect."""
        if len(node.value) > _MAX_DIGITS or abs(number := int(node.value)) > _MAX_INT:
            raise _marked_error(f"this number is beyond {_MAX_INT}", node)
        return number

    def checked_float(self, node: yaml.ScalarNode) -> float:
        """Return a number with a fraction or an exponent."""
        if len(node.value) > _MAX_DIGITS or not math.isfinite(number := float(node.value)):
            raise _marked_error("this number is too large, or has too many digits", node)
        return number


class _JoinedItemError(yaml.YAMLError):
    """An item of a list is indented more than the previous item, so YAML reads it as a part of that item's text.

    Attributes:
        line: Line of the item, from 1.
    """

    def __init__(self, line: int) -> None:
        super().__init__("this item is a part of the text before it")
        self.line = line


def _marked_error(text: str, place: yaml.Node | yaml.Event) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=text, problem_mark=place.start_mark)  # type: ignore[arg-type] # marks of the C parser have a line, too


# The type annotations of PyYAML accept only its own loaders.
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.checked_int)  # type: ignore[type-var]
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.checked_float)  # type: ignore[type-var]


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes text which YAML 1.1 or 1.2 would read as a number, such as the hash `6372e70369712148`.

    It also escapes the line ends of YAML 1.1 other than the line feed. SafeDumper does not escape them, so they would
    be read back as spaces.
    """

    def represent_text(self, text: str) -> yaml.Node:
        """Return a text as a node."""
        style = '"' if _OTHER_LINE_ENDS.intersection(text) else None
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_OTHER_LINE_ENDS: Final = frozenset("\r\N{NEXT LINE}\N{LINE SEPARATOR}\N{PARAGRAPH SEPARATOR}")
_Dumper.add_representer(str, _Dumper.represent_text)


# The core schema of YAML 1.2: for each tag, the pattern of its values and their possible first characters.
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


# PyYAML converts some escapes and directives without checks, so invalid ones raise ValueError or OverflowError.
_YAML_ERRORS: Final = (yaml.YAMLError, ValueError, OverflowError)


@dataclass(frozen=True)
class Document:
    """A YAML document with the line of each value.

    Attributes:
        data: Plain values: dict, list, str, int, float, bool, None.
        source: The file's name, for messages.
        lines: Line (from 1) per location, a tuple of keys and indices; the root is `()`.
        place: Location of this document in the file; `()` if it is the whole file.
    """

    data: Any
    source: str
    lines: dict[Location, int]
    place: Location = ()

    def where(self, location: Location) -> str:
        """Return `file:line` of the innermost part of `location` that exists in the file."""
        return f"{self.source}:{self.lines.get(self.existing_part(location), 1)}"

    def existing_part(self, location: Location) -> Location:
        """Return a location without the parts that do not exist in the file.

        Such a part is a missing key, or the tag that pydantic inserts for a tagged union.
        """
        existing: Location = ()
        for part in location:
            existing = (*existing, part) if (*existing, part) in self.lines else existing
        return existing

    def has_key(self, key: str) -> bool:
        """Return True if any mapping of the document has this key."""
        remaining = [self.data]
        while remaining:
            value = remaining.pop()
            if isinstance(value, dict):
                if key in value:
                    return True
                remaining += value.values()
            elif isinstance(value, list):
                remaining += value
        return False

    @contextmanager
    def locating_errors(self, *location: str | int) -> Iterator[None]:
        """Add `file:line` of a location to errors that the body raises without a place."""
        try:
            yield
        except ConfigurationError as error:
            error.where = error.where or self.where(location)
            raise

    def part(self, *location: str | int) -> "Document":
        """Return the value at `location` as a separate document with its lines."""
        data = self.data
        for key in location:
            data = data[key]
        size = len(location)
        lines = {place[size:]: line for place, line in self.lines.items() if place[:size] == location}
        return Document(data=data, source=self.source, lines=lines, place=(*self.place, *location))


def read(path: Path) -> Document:
    """Read one YAML file. Raises the same errors as `parse`, and an error if the file cannot be read."""
    return parse(_text(path), source=str(path))


def _text(path: Path) -> str:
    """Return the text of a regular file of at most 1 MiB; devices and pipes are refused because reads may block."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ConfigurationError("this is not a file", where=str(path), remedy="name a YAML file")
        if status.st_size > _MAX_BYTES:
            raise ConfigurationError(
                "the file is larger than 1 MiB", where=str(path), remedy="check that it is the right file"
            )
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be read: {error.strerror}",
            where=str(path),
            remedy=f"check its name and permissions: {shell_command('ls', '-l', path)}",
        ) from error
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        line = 1 if is_utf16 else data.count(b"\n", 0, error.start) + 1
        remedy = "save it as UTF-8, not as UTF-16" if is_utf16 else "save it as UTF-8"
        raise ConfigurationError("cannot be read: it is not UTF-8", where=f"{path}:{line}", remedy=remedy) from error


def parse(text: str, *, source: str) -> Document:
    """Return the one YAML document in `text`.

    Raises:
        ConfigurationError: The text is not YAML, or has an alias, a tag, a duplicate key, or a key that is not text.
    """
    loader = None
    try:
        loader = _Loader(text)
        return _document(loader, source)
    except _YAML_ERRORS as error:
        raise _configuration_error(error, text, source, loader.line + 1 if loader else 1) from error


def _document(loader: _Loader, source: str) -> Document:
    lines: dict[Location, int] = {}
    try:
        node = loader.get_single_node()
        return Document(data=None if node is None else _to_plain(loader, node, (), lines), source=source, lines=lines)
    finally:
        loader.dispose()


_REMEDIES: Final = {
    "character '\\t'": "indent with spaces, not with tabs",
    "cannot start any token": "put this text in quotes",
    "part of the text before it": "indent this item with as many spaces as the other items of its list",
    "expected <block end>": "indent this line with as many spaces as the other lines of its list or mapping",
    "mapping values are not allowed": "quote text that contains a colon; indent all keys of a mapping equally",
}
"""Remedies by a part of the message of an error, of PyYAML or of this module."""


def _configuration_error(error: Exception, text: str, source: str, line: int) -> ConfigurationError:
    """Return an error of PyYAML as an error with file, line and remedy."""
    if isinstance(error, yaml.reader.ReaderError):
        message = f"a text file cannot contain the character {error.character:#04x}"
        line = text.count("\n", 0, error.position) + 1
    elif isinstance(error, _JoinedItemError):
        message, line = str(error), error.line
    elif isinstance(error, yaml.MarkedYAMLError):
        message = str(error.problem or error.context)
        mark = error.problem_mark or error.context_mark
        line = line if mark is None else mark.line + 1
    else:
        message = f"an escape or a directive is not valid: {error}"
    remedy = next((remedy for part, remedy in _REMEDIES.items() if part in message), "correct the line named above")
    return ConfigurationError(f"not valid YAML: {message}", where=f"{source}:{line}", remedy=remedy)


def _to_plain(loader: _Loader, node: yaml.Node, place: Location, lines: dict[Location, int]) -> Any:  # noqa: ANN401
    """Return a node as plain values, and store the line of each part in `lines`."""
    lines.setdefault(place, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[(*place, index)] = item.start_mark.line + 1
        return [_to_plain(loader, item, (*place, index), lines) for index, item in enumerate(node.value)]
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
                raise _marked_error(problem, key_node)
            lines[(*place, key)] = key_node.start_mark.line + 1
            mapping[key] = _to_plain(loader, value_node, (*place, key), lines)
        return mapping
    return loader.construct_object(node)


def to_text(data: object) -> str:
    """Return plain values as YAML that `parse` reads back as equal values."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def compose(text: str) -> yaml.Node | None:
    """Return the syntax tree of a document, with the position of each value; None if the document is empty.

    Raises:
        ValueError: The document is not valid YAML.
    """
    try:
        root: yaml.Node | None = _Loader(text).get_single_node()
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
    return root
