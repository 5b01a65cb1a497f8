"""Strict YAML: load, validate against a model, freeze; every complaint names file, line and the nearest key.

The only module that imports pyyaml and pydantic. Profiles, procedures, site files and back-end options are
subclasses of `Strict`, loaded by `load`.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    StrictBool,
    StrictFloat,
    StrictInt,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError

from fieldkit import units
from fieldkit.errors import ConfigurationError, nearest
from fieldkit.model import Distance

__all__ = [
    "AfterValidator",
    "BeforeValidator",
    "Bits",
    "Bool",
    "Document",
    "Duration",
    "Field",
    "Fraction",
    "Hertz",
    "Int",
    "Length",
    "Number",
    "Span",
    "Strict",
    "complaint",
    "dump",
    "load",
    "model_validator",
    "parse",
    "read",
    "validate",
]

_MAX_BYTES: Final = 1 << 20

Location = tuple[str | int, ...]
Quantity = TypeVar("Quantity")


def complaint(text: str, *at: str | int) -> Exception:
    """Return the exception that a validator raises; `text` reaches the user with file and line.

    Args:
        text: What is wrong.
        at: Keys and indices that lead from the validated value to the part that is wrong, for the line.
    """
    return PydanticCustomError("complaint", "{text}", {"text": text, "at": at})


def _written(parse: Callable[[str], Quantity], symbol: str) -> BeforeValidator:
    def convert(value: object) -> Quantity:
        if not isinstance(value, str):
            raise complaint(f"{value!r} has no unit; write for example 20{symbol}")
        try:
            return parse(value)
        except ConfigurationError as error:
            raise complaint(f"{error.what}; {error.remedy}") from None

    return BeforeValidator(convert)


def _quantity(parse: Callable[[str], float], symbol: str, factor: float = 1.0) -> tuple[object, object]:
    shown = PlainSerializer(lambda value: f"{value / factor:.12g}{symbol}", return_type=str)
    return _written(parse, symbol), shown


def _unit(table: dict[str, float], what: str) -> Callable[[str], float]:
    return lambda text: units.parse_quantity(text, table, what)


Int = StrictInt
Number = StrictFloat
Bool = StrictBool

Duration = Annotated[float, *_quantity(units.parse_duration_s, "s")]
"""Seconds, written with a unit."""
Hertz = Annotated[float, *_quantity(_unit(units.HERTZ_PER_UNIT, "rate"), "Hz")]
"""Hertz, written with a unit."""
Bits = Annotated[float, *_quantity(_unit(units.BITS_PER_S_PER_UNIT, "bit rate"), "Mbit/s", 1e6)]
"""Bits per second, written with a unit."""
Fraction = Annotated[float, *_quantity(_unit(units.FRACTION_PER_UNIT, "share"), "%", 0.01), Field(ge=0, le=1)]
"""A share between 0 and 1, written in per cent."""
Length = Annotated[float, *_quantity(_unit(units.METRES_PER_UNIT, "length"), "m")]
"""Metres, written with a unit."""
Span = Annotated[
    Distance, _written(units.parse_distance, "ft"), PlainSerializer(lambda value: value.label, return_type=str)
]
"""A distance that keeps the operator's label."""


class Strict(BaseModel):
    """Base of everything read from YAML: frozen, no unknown keys.

    Numbers and booleans are declared as `Int`, `Number` and `Bool`, which convert nothing silently.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        valid = [field.alias or name for name, field in cls.model_fields.items()]
        for key in data:
            if key not in valid:
                hint = nearest(str(key), valid, f"valid keys: {', '.join(valid)}")
                raise PydanticCustomError("unknown_key", "unknown key {key}; {hint}", {"key": str(key), "hint": hint})
        return data


Model = TypeVar("Model", bound=Strict)


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
    """SafeDumper that quotes what either version of YAML takes for a number: a hash may be `6372e70369712148`."""


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


def load(path: Path, model: type[Model]) -> Model:
    """Read `path` and validate it against `model`; errors as `read` and `validate`."""
    return validate(read(path), model)


def validate(document: Document, model: type[Model]) -> Model:
    """Return `document` as a frozen `model`.

    Raises:
        ConfigurationError: The first problem in the file, with file, line, key path and, for an unknown key, the
            nearest valid one.
    """
    try:
        return model.model_validate(document.data)
    except ValidationError as error:
        raise _explain(error, document) from error


def _explain(error: ValidationError, document: Document) -> ConfigurationError:
    def rank(problem: Any) -> tuple[bool, int]:  # noqa: ANN401 (pydantic's own ErrorDetails)
        # A list whose only item is wrong counts as empty too, which would hide what is wrong.
        return problem["type"] == "too_short", int(document.where(_location(problem)).rsplit(":", 1)[1])

    problems = sorted(error.errors(), key=rank)
    first = problems[0]
    location = _location(first)
    place: Location = first["loc"]
    message = first["msg"]
    if first["type"] == "missing":
        place, message = place[:-1], f"required key {place[-1]!r} is missing"
    elif place and place[-1] == "[key]":
        place, message = place[:-2], f"{place[-2]!r} cannot be a key here: {message}"
    path = ".".join(str(part) for part in (*document.place, *place))
    more = f" ({len(problems) - 1} more after this one)" if len(problems) > 1 else ""
    return ConfigurationError(
        f"{f'in {path}: ' if path else ''}{message}{more}",
        where=document.where(location),
        remedy="mend this line; docs/reference.md lists the keys of every file",
    )


def _location(problem: Any) -> Location:  # noqa: ANN401 (pydantic's own ErrorDetails)
    location: Location = problem["loc"]
    context = problem.get("ctx", {})
    key = context.get("key")
    return (*location, *context.get("at", ()), *(() if key is None else (key,)))


def dump(model: Strict) -> str:
    """Return the YAML that `load` reads back as an equal model; what is None is left out."""
    data = model.model_dump(mode="json", by_alias=True, exclude_none=True)
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)
