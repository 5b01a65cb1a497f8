"""Strict YAML and JSON: load, validate, freeze; every complaint on YAML names file, line and the nearest key.

The only module that imports pydantic. Profiles, procedures, site files and back-end options are subclasses of
`Strict`, loaded by `load`; records that only programs write go through a `Codec`.
"""

import json
import os
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from decimal import Decimal
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PlainSerializer,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    StrictBool,
    StrictFloat,
    StrictInt,
    TypeAdapter,
    ValidationError,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError, SchemaValidator, core_schema

from fieldkit.config import misplaced, problems
from fieldkit.config.documents import Document, Location, parse, read, to_text
from fieldkit.core import units
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import Distance

__all__ = [
    "AfterValidator",
    "BeforeValidator",
    "Bits",
    "Bool",
    "Bytes",
    "Codec",
    "CoreSchema",
    "Document",
    "Duration",
    "Field",
    "Fraction",
    "Hertz",
    "Int",
    "Length",
    "Location",
    "Number",
    "SerializerFunctionWrapHandler",
    "Span",
    "Speed",
    "Strict",
    "by_kind",
    "complaint",
    "dump",
    "folder",
    "is_empty",
    "load",
    "model_serializer",
    "model_validator",
    "parse",
    "read",
    "shaped",
    "validate",
]

# Before it builds its first model, pydantic searches the files of all installed packages for plugins: 25 ms.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")

Quantity = TypeVar("Quantity")

_AROUND: ContextVar[tuple[type["Strict"], ...]] = ContextVar("_AROUND", default=())
"""The models of the mappings around the one that is validated now, the outermost first."""
_FOLDER: ContextVar[Path] = ContextVar("_FOLDER", default=Path())


def complaint(text: str, *at: str | int) -> Exception:
    """Return the exception that a validator raises; `text` reaches the user with file and line.

    Args:
        text: What is wrong.
        at: Keys and indices that lead from the validated value to the part that is wrong, for the line.
    """
    return PydanticCustomError("complaint", "{text}", {"text": text, "at": at})


def shaped(pattern: str, words: str) -> Any:  # noqa: ANN401 (as pydantic's own `Field`)
    """Return the `Field` of a text that has to match a pattern.

    Args:
        pattern: A regular expression for the whole text.
        words: What such a text is, for who wrote another: `a name in small letters`.
    """
    problems.SHAPES[pattern] = words
    return Field(pattern=pattern)


def _written(parse: Callable[[str], Quantity], symbol: str) -> BeforeValidator:
    def convert(value: object) -> Quantity:
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise complaint(f"a number with a unit is needed here; write for example 20{symbol}")
        try:
            return parse(str(value))
        except ConfigurationError as error:
            raise complaint(f"{error.what}; {error.remedy}") from None

    return BeforeValidator(convert)


def _quantity(parse: Callable[[str], float], symbol: str, factor: float = 1.0) -> tuple[object, object, object]:
    def show(value: float) -> str:
        # Quantities are written out in digits, and read so: a float's own text has an exponent below 0.0001.
        return f"{Decimal(f'{value / factor:.12g}'):f}{symbol}"

    shown = PlainSerializer(show, return_type=str)
    return _written(parse, symbol), shown, WithJsonSchema({"type": "string", "examples": [f"20{symbol}"]})


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
Bytes = Annotated[float, *_quantity(_unit(units.BYTES_PER_UNIT, "size"), "B"), Field(gt=0)]
"""Bytes, written with a unit."""
Fraction = Annotated[float, *_quantity(_unit(units.FRACTION_PER_UNIT, "share"), "%", 0.01), Field(ge=0, le=1)]
"""A share between 0 and 1, written in per cent."""
Length = Annotated[float, *_quantity(_unit(units.METRES_PER_UNIT, "length"), "m")]
"""Metres, written with a unit."""
Speed = Annotated[float, *_quantity(_unit(units.METRES_PER_S_PER_UNIT, "speed"), "m/s")]
"""Metres per second, written with a unit."""
Span = Annotated[
    Distance, _written(units.parse_distance, "ft"), PlainSerializer(lambda value: value.label, return_type=str)
]
"""A distance that keeps the operator's label."""


class Strict(BaseModel):
    """Base of everything read from YAML: frozen, no unknown keys.

    Numbers and booleans are declared as `Int`, `Number` and `Bool`, which convert nothing silently.
    """

    # Most commands use few of the many models: each is built when it is first used.
    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True, defer_build=True)

    @classmethod
    def written_out(cls, document: Document) -> Document:
        """Return a document of this model with whatever stands for more than itself written out; most have nothing.

        Raises:
            ConfigurationError: It stands for nothing.
        """
        return document

    @classmethod
    def defaults(cls) -> Self:
        """Return what an empty mapping gives, without building what validates others: for the default of a field."""
        return cls.model_construct()

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        fields = _types(cls)
        for key in data:
            if key not in fields:
                outer = [_types(model) for model in _AROUND.get()[:-1]]
                hint, of = misplaced.hint(key, data, fields, outer)
                raise _unknown(str(key), hint, outer[of] if of >= 0 else ())
        return data

    @model_validator(mode="wrap")
    @classmethod
    def _knows_what_is_around(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        token = _AROUND.set((*_AROUND.get(), cls))
        try:
            return handler(data)
        finally:
            _AROUND.reset(token)


def _types(model: type[Strict]) -> dict[str, Any]:
    """Return the type of each key of a model."""
    return {field.alias or name: field.annotation for name, field in model.model_fields.items()}


def _unknown(key: str, hint: str, outer: Iterable[str] = ()) -> Exception:
    """Return the exception for an unknown key.

    Args:
        key: The key.
        hint: What to do about it.
        outer: All keys of the mapping around, where the key is one of these.
    """
    context = {"key": key, "hint": hint, "outer": tuple(outer)}
    return PydanticCustomError("unknown_key", "unknown key {key}; {hint}", context)


def is_empty(value: object) -> bool:
    """Return whether a value says nothing and need not be written: for `exclude_if` of a default that is so."""
    return not value


Model = TypeVar("Model", bound=Strict)
Item = TypeVar("Item")


def by_kind(
    kinds: Callable[[], Mapping[str, type[Model]]],
    make: Callable[[str, Model], Item],
    take: Callable[[Item], tuple[str, Model]],
    what: str,
) -> CoreSchema:
    """Return the schema of a mapping with one key, which says of what model its value is: `- ping: {...}`.

    Args:
        kinds: The models by key; asked when something is validated, so that they may hold such mappings themselves.
        make: Makes the object that stands for the mapping.
        take: Gives key and value back.
        what: One of them, for messages.
    """

    def validated(data: Any) -> Item:  # noqa: ANN401 (any YAML value, or what was validated before)
        if not isinstance(data, Mapping):
            return _made(data)
        known = kinds()
        if unknown := next((str(key) for key in data if key not in known), None):
            around = next((str(key) for key in data if key in known and unknown in _types(known[key])), None)
            valid = f"valid keys: {', '.join(known)}; a {what} of another kind comes with a package to be installed"
            hint = f"it is a key of {around}: write it inside" if around else nearest(unknown, known, valid)
            outer = [] if around else [types for model in _AROUND.get() if unknown in (types := _types(model))]
            raise _unknown(unknown, hint, outer[-1] if outer else ())
        if len(data) != 1:
            raise complaint(f"a {what} has one kind, one of: {', '.join(known)}")
        ((kind, value),) = data.items()
        # Under its key, so that an error says where it is.
        located = SchemaValidator(core_schema.typed_dict_schema({kind: _field_of(known[kind])}))
        return make(kind, located.validate_python({kind: value})[kind])

    def _made(data: Any) -> Item:  # noqa: ANN401 (as above)
        try:
            take(data)
        except AttributeError:
            raise complaint(f"a {what} is a mapping with one key, one of: {', '.join(kinds())}") from None
        made: Item = data
        return made

    def plain(item: Item, info: SerializationInfo) -> dict[str, Any]:
        kind, value = take(item)
        data = value.model_dump(
            mode=info.mode,
            by_alias=bool(info.by_alias),
            exclude_none=info.exclude_none,
            exclude_unset=info.exclude_unset,
        )
        return {kind: data}

    return core_schema.no_info_plain_validator_function(
        validated, serialization=core_schema.plain_serializer_function_ser_schema(plain, info_arg=True)
    )


def _field_of(model: type[Strict]) -> core_schema.TypedDictField:
    return core_schema.typed_dict_field(core_schema.no_info_plain_validator_function(model.model_validate))


def load(path: Path, model: type[Model]) -> Model:
    """Read `path` and validate it against `model`; errors as `read` and `validate`."""
    return validate(read(path), model)


def validate(document: Document, model: type[Model]) -> Model:
    """Return `document` as a frozen `model`.

    Raises:
        ConfigurationError: The first problem in the file, with file, line, key path and, for an unknown key, the
            nearest valid one.
    """
    document = model.written_out(document)
    token = _FOLDER.set(Path(document.source).parent)
    try:
        return model.model_validate(document.data)
    except ValidationError as error:
        raise problems.explain(error.errors(), document) from error
    finally:
        _FOLDER.reset(token)


def folder() -> Path:
    """Return the folder of the file that is validated now; the current directory where none is."""
    return _FOLDER.get()


def dump(model: Strict) -> str:
    """Return the YAML that `load` reads back as an equal model; what is None is left out."""
    data = model.model_dump(mode="json", by_alias=True, exclude_none=True)
    return to_text(data)


Record = TypeVar("Record")


class Codec(Generic[Record]):
    """Records of one type to plain JSON values and back, for lines of a journal and messages between programs.

    A field of another name in the file is declared as `Annotated[str, Field(alias="other")]`.

    Args:
        record: The type, for example a frozen dataclass whose fields are annotated.
    """

    def __init__(self, record: type[Record]) -> None:
        self._record = record

    @cached_property
    def _adapter(self) -> TypeAdapter[Record]:
        return TypeAdapter(self._record)  # takes 10 ms, and few commands have a use for each

    def parse(self, data: Any) -> Record:  # noqa: ANN401 (any JSON value)
        """Return the record that a JSON value holds; a field that is missing has its default, none is converted.

        Raises:
            ValueError: It holds none.
        """
        try:
            # Strictly, pydantic takes a list for a tuple and a word for an enumeration only out of JSON's own text.
            # Half a surrogate pair, which Python's reader takes, is no text there and would be no entry.
            text = json.dumps(data, ensure_ascii=False).encode(errors="replace")
            return self._adapter.validate_json(text, strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise ValueError(f"{place}: {first['msg']}" if place else first["msg"]) from error

    def dump(self, record: Record) -> Any:  # noqa: ANN401 (any JSON value)
        """Return the JSON value that `parse` makes an equal record of."""
        return self._adapter.dump_python(record, mode="json", by_alias=True)
