"""Strict YAML: load, validate against a model, freeze; every complaint names file, line and the nearest key.

The only module that imports pydantic. Profiles, procedures, site files and back-end options are subclasses of
`Strict`, loaded by `load`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

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

from fieldkit.config.documents import Document, Location, parse, read, to_text
from fieldkit.core import units
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import Distance

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
    "Location",
    "Number",
    "Span",
    "Speed",
    "Strict",
    "complaint",
    "dump",
    "load",
    "model_validator",
    "parse",
    "read",
    "validate",
]

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
    return to_text(data)
