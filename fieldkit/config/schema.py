"""Load, validate and freeze YAML and JSON. Errors in YAML contain file, line and the most similar valid key.

This is the only module that imports pydantic. Profiles, procedures, site files and options of backends are subclasses
of `Strict`, loaded by `load`.
"""

from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple, Self, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
    ModelWrapValidatorHandler,
    PlainSerializer,
    PlainValidator,
    RootModel,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    StrictBool,
    StrictFloat,
    StrictInt,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError, SchemaValidator, core_schema

from fieldkit.config.documents import Document, Location, parse, read, to_text
from fieldkit.core import units
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Distance

__all__ = [
    "AfterValidator",
    "BaseModel",
    "BeforeValidator",
    "Bits",
    "Bool",
    "Bytes",
    "ConfigDict",
    "CoreSchema",
    "Document",
    "Duration",
    "Field",
    "Fraction",
    "Hertz",
    "Int",
    "JsonValue",
    "Length",
    "Location",
    "Names",
    "Number",
    "PlainSerializer",
    "PlainValidator",
    "RootModel",
    "SectionValue",
    "SerializerFunctionWrapHandler",
    "Span",
    "Speed",
    "Strict",
    "TypeAdapter",
    "ValidationError",
    "ValidationInfo",
    "WithJsonSchema",
    "by_kind",
    "dump",
    "folder",
    "is_empty",
    "load",
    "model_serializer",
    "model_validator",
    "parse",
    "pattern_field",
    "read",
    "validate",
    "validation_error",
]

Quantity = TypeVar("Quantity")

_ENCLOSING: ContextVar[tuple[type["Strict"], ...]] = ContextVar("_ENCLOSING", default=())
"""Models of the mapping that is being validated and of its enclosing mappings, the outermost first."""
_PATTERN_DESCRIPTIONS: Final[dict[str, str]] = {}
"""Description of a valid text by pattern; see `pattern_field`."""
_FOLDER: ContextVar[Path] = ContextVar("_FOLDER", default=Path())


def validation_error(text: str, *at: str | int, remedy: str = "") -> Exception:
    """Return the exception that a validator raises. The message to the user contains `text`, file and line.

    Args:
        text: Description of the error.
        at: Keys and indices from the validated value to the invalid part, for the line.
        remedy: The remedy, unless it is the correction of that line.
    """
    return PydanticCustomError("fieldkit_error", "{text}", {"text": text, "at": at, "remedy": remedy})


def pattern_field(pattern: str, description: str) -> Any:  # noqa: ANN401 (pydantic's `Field` also returns Any)
    """Return the `Field` of a text that must match a pattern.

    Args:
        pattern: A regular expression for the whole text.
        description: Description of a valid text for error messages: `a name in lower-case letters`.
    """
    _PATTERN_DESCRIPTIONS[pattern] = description
    return Field(pattern=pattern)


def _converter(parse: Callable[[str], Quantity], symbol: str) -> BeforeValidator:
    def convert(value: object) -> Quantity:
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise validation_error(f"a number with a unit is needed here; write for example 20{symbol}")
        try:
            return parse(str(value))
        except ConfigurationError as error:
            raise validation_error(f"{error.what}; {error.remedy}") from None

    return BeforeValidator(convert)


def _quantity(parse: Callable[[str], float], symbol: str, factor: float = 1.0) -> tuple[object, object, object]:
    def format_value(value: float) -> str:
        return f"{units.plain_number(value / factor)}{symbol}"

    serializer = PlainSerializer(format_value, return_type=str)
    return _converter(parse, symbol), serializer, WithJsonSchema({"type": "string", "examples": [f"20{symbol}"]})


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
Names = Annotated[frozenset[str], PlainSerializer(sorted, return_type=list[str])]
"""A set of names, written in alphabetical order."""
Span = Annotated[
    Distance, _converter(units.parse_distance, "ft"), PlainSerializer(lambda value: value.label, return_type=str)
]
"""A distance, written back with the operator's label."""


class _UnvalidatedSection(NamedTuple):
    """The unvalidated value of a section of an installed package, with the model that validates it."""

    model: type[BaseModel]
    value: object


def _validated_section(section: object) -> object:
    return section.model.model_validate(section.value) if isinstance(section, _UnvalidatedSection) else section


SectionValue = Annotated[Any, BeforeValidator(_validated_section)]
"""Type of the values of additional keys in a mapping with sections."""


class Strict(BaseModel):
    """Base of all models that are read from YAML. They are frozen and reject unknown keys.

    Numbers and booleans are declared as `Int`, `Number` and `Bool`, which do not convert other types.
    """

    # Most commands use few of the models, so each is built at first use.
    model_config = ConfigDict(frozen=True, extra="forbid", hide_input_in_errors=True, defer_build=True)

    @classmethod
    def expanded(cls, document: Document) -> Document:
        """Return a document with constructs such as `for:` expanded; most models have none.

        Raises:
            ConfigurationError: A construct is not valid.
        """
        return document

    @classmethod
    def defaults(cls) -> Self:
        """Return the object of an empty mapping without building a validator, for the default of a field."""
        return cls.model_construct()

    @classmethod
    def section_types(cls) -> Mapping[str, type[BaseModel]]:
        """Return the models of additional keys, which installed packages define; most mappings have none."""
        return {}

    @classmethod
    def missing_package(cls, key: str) -> str:  # noqa: ARG003 (most mappings have no keys of packages)
        """Return the package that must be installed for a key to be valid; empty if no such package is known."""
        return ""

    @model_validator(mode="before")
    @classmethod
    def _reject_unknown_keys(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        names, sections = _names(cls), cls.section_types()
        for key in data:
            if key not in names and key not in sections:
                raise cls._unknown_key(key, data)
        if not sections:
            return data
        return {
            key: value if key in names else _UnvalidatedSection(sections[key], value)
            for key, value in data.items()
            if key in names or value is not None
        }

    @classmethod
    def _unknown_key(cls, key: Any, data: Mapping[Any, Any]) -> Exception:  # noqa: ANN401 (any YAML value)
        if package := cls.missing_package(str(key)):
            return _unknown(str(key), f"it needs the package {package}, which is not installed")
        from fieldkit.config import yaml_errors  # noqa: PLC0415 (needed only for files with errors; also below)

        outer = [_types(model) for model in _ENCLOSING.get()[:-1]]
        hint, index = yaml_errors.misplaced_hint(key, data, _types(cls), outer)
        return _unknown(str(key), hint, outer[index] if index >= 0 else ())

    @model_validator(mode="wrap")
    @classmethod
    def _track_enclosing(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        token = _ENCLOSING.set((*_ENCLOSING.get(), cls))
        try:
            return handler(data)
        finally:
            _ENCLOSING.reset(token)


def _names(model: type[Strict]) -> frozenset[str]:
    """Return the keys of a model, without the keys of sections."""
    return frozenset(field.alias or name for name, field in model.model_fields.items())


def _types(model: type[Strict]) -> dict[str, Any]:
    """Return the type of each key of a model."""
    fields = {field.alias or name: field.annotation for name, field in model.model_fields.items()}
    return {**fields, **model.section_types()}


def _unknown(key: str, hint: str, outer: Iterable[str] = ()) -> Exception:
    """Return the exception for an unknown key.

    Args:
        key: The key.
        hint: How to correct it.
        outer: All keys of the enclosing mapping in which the key is valid, if any.
    """
    context = {"key": key, "hint": hint, "outer": tuple(outer)}
    return PydanticCustomError("unknown_key", "unknown key {key}; {hint}", context)


def is_empty(value: object) -> bool:
    """Return True if a value is empty; the `exclude_if` of fields that are omitted if they are empty."""
    return not value


Model = TypeVar("Model", bound=Strict)
AnyModel = TypeVar("AnyModel", bound=BaseModel)
Item = TypeVar("Item")


def by_kind(
    kinds: Callable[[], Mapping[str, type[Model]]],
    make: Callable[[str, Model], Item],
    split: Callable[[Item], tuple[str, Model]],
    what: str,
) -> CoreSchema:
    """Return the schema of a mapping with one key that selects the model of its value: `- ping: {...}`.

    Args:
        kinds: Returns the models by key. It is called during validation, so that models can contain such mappings.
        make: Returns the object for a key and a value.
        split: Returns the key and the value of an object.
        what: Noun for an item in messages.
    """

    def validate_item(data: Any) -> Item:  # noqa: ANN401 (any YAML value, or an object that `make` returned)
        if not isinstance(data, Mapping):
            return _require_item(data)
        models = kinds()
        if unknown := next((str(key) for key in data if key not in models), None):
            parent = next((str(key) for key in data if key in models and unknown in _types(models[key])), None)
            valid = did_you_mean(unknown, models, f"valid keys: {', '.join(models)};")
            hint = f"{valid} other kinds of {what} need a package that is not installed"
            if parent:
                hint = f"it is a key of {parent}: write it inside"
            outer = [] if parent else [types for model in _ENCLOSING.get() if unknown in (types := _types(model))]
            raise _unknown(unknown, hint, outer[-1] if outer else ())
        if len(data) != 1:
            raise validation_error(f"a {what} has one kind, one of: {', '.join(models)}")
        ((kind, value),) = data.items()
        return make(kind, _validated_under(kind, models[kind], value))

    def _require_item(data: Any) -> Item:  # noqa: ANN401 (as above)
        try:
            split(data)
        except AttributeError:
            raise validation_error(f"a {what} is a mapping with one key, one of: {', '.join(kinds())}") from None
        item: Item = data
        return item

    def serialize(item: Item, info: SerializationInfo) -> dict[str, Any]:
        kind, value = split(item)
        data = value.model_dump(
            mode=info.mode,
            by_alias=bool(info.by_alias),
            exclude_none=info.exclude_none,
            exclude_unset=info.exclude_unset,
        )
        return {kind: data}

    return core_schema.no_info_plain_validator_function(
        validate_item, serialization=core_schema.plain_serializer_function_ser_schema(serialize, info_arg=True)
    )


def _validated_under(key: str, model: type[AnyModel], value: object) -> AnyModel:
    """Return the object of a value; the locations of its errors begin with `key`."""
    validator = core_schema.no_info_plain_validator_function(model.model_validate)
    nested_validator = SchemaValidator(core_schema.typed_dict_schema({key: core_schema.typed_dict_field(validator)}))
    validated: AnyModel = nested_validator.validate_python({key: value})[key]
    return validated


def load(path: Path, model: type[Model]) -> Model:
    """Read `path` and validate it against `model`. Raises the same errors as `read` and `validate`."""
    return validate(read(path), model)


def validate(document: Document, model: type[Model]) -> Model:
    """Return `document` as a frozen `model`.

    Raises:
        ConfigurationError: The first problem in the file, with file, line, key path and, for an unknown key, the
            most similar valid key.
    """
    document = model.expanded(document)
    token = _FOLDER.set(Path(document.source).parent)
    try:
        return model.model_validate(document.data)
    except ValidationError as error:
        from fieldkit.config import yaml_errors  # noqa: PLC0415

        raise yaml_errors.explain(error.errors(), document, _PATTERN_DESCRIPTIONS) from error
    finally:
        _FOLDER.reset(token)


def folder() -> Path:
    """Return the folder of the file that is being validated, or the current directory if there is no file."""
    return _FOLDER.get()


def dump(model: Strict) -> str:
    """Return the YAML that `load` reads back as an equal model; values that are None are omitted."""
    data = model.model_dump(mode="json", by_alias=True, exclude_none=True)
    return to_text(data)
