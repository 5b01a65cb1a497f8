"""The page of the options of simulators, from their models."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Final, Literal, get_args, get_origin

from pydantic import WithJsonSchema
from pydantic.fields import FieldInfo

from docs.generator.markdown import page, relative, table
from docs.generator.models import default, describe
from fieldkit.config.documentation import attribute_meanings
from sim_backends.federates.frames import ROLES
from sim_backends.federates.named import federates
from sim_backends.federates.simulator_options import SimulatorOptions

_UNITS: Final = {"_per_s": "1/s", "_m_s2": "m/s²", "_bytes": "bytes", "_s": "s", "_m": "m"}
"""Units of keys by the ending of the key; the first matching ending applies."""
_TYPES: Final[Mapping[object, str]] = {bool: "`true`, `false`", int: "integer", float: "number", str: "text"}
_BOUNDS: Final = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}


def simulator_options() -> str:
    """Return the page."""
    blocks = []
    for name, federate in federates().items():
        model = federate.options
        if model is None or not model.__module__.startswith("sim_backends."):
            continue
        blocks += [f"## {name}", describe(model)]
        if model.model_fields:
            blocks += [f"Keys of `{ROLES[federate.role]}.options`:", _keys_table(model)]
    return page(
        "Options of simulators",
        "Keys of `physics.options` or `network.options` in a [scenario file](scenario-file.md) whose `federate` is "
        "the name of an installed simulator. On the command line: `--set physics.options.KEY=VALUE`. fieldkit checks "
        "them before anything starts. If `federate` is a [command or an address](../federates.md), its "
        "program checks the options.",
        *blocks,
    )


def _keys_table(model: type[SimulatorOptions]) -> str:
    meanings = attribute_meanings(model)
    lines = (
        (
            f"`{key}`",
            values(field.annotation, field.metadata, _unit(key)),
            default(model, key),
            relative(meanings[key]),
        )
        for key, field in model.model_fields.items()
    )
    return table(("key", "values", "default", "meaning"), lines)


def _unit(key: str) -> str:
    return next((unit for ending, unit in _UNITS.items() if key.endswith(ending)), "")


def values(annotation: Any, metadata: Any = (), unit: str = "") -> str:  # noqa: ANN401 (annotations have any type)
    """Return the description of the valid values of a type.

    Args:
        annotation: The type.
        metadata: Its annotations: limits, and the JSON schema of a quantity.
        unit: Unit of its numbers.
    """
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return values(inner, (*more, *metadata), unit)
    kind = get_origin(annotation)
    if kind is None:
        return _with_limits(annotation, list(_flat(metadata)), unit)
    parts = [part for part in get_args(annotation) if part is not type(None)]
    if kind in {Literal, dict, tuple}:
        return _with_items(kind, parts, unit)
    if {_bare(part) for part in parts} <= {int, float}:  # `2` and `2.5` are numbers
        return _with_limits(float, list(_flat((*metadata, *_metadata(parts)))), unit)
    return values(parts[0], metadata, unit)


def _with_items(kind: object, parts: list[Any], unit: str) -> str:
    """Return the description of the values of a choice, a mapping or a list."""
    if kind is Literal:
        return ", ".join(f"`{part}`" for part in parts)
    if kind is dict:
        return f"by agent: {values(parts[1], (), unit)}"
    items = dict.fromkeys(values(part, (), unit) for part in parts)
    return f"list of {len(parts)}: {'; '.join(items)}"


def _bare(annotation: Any) -> Any:  # noqa: ANN401 (as above)
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation


def _metadata(parts: list[Any]) -> Iterator[Any]:
    for part in parts:
        yield from get_args(part)[1:]


def _flat(metadata: Any) -> Iterator[Any]:  # noqa: ANN401 (as above)
    for item in metadata:
        yield from item.metadata if isinstance(item, FieldInfo) else (item,)


def _with_limits(kind: Any, metadata: list[Any], unit: str) -> str:  # noqa: ANN401 (as above)
    """Return the description of a scalar with its limits and its unit."""
    text = _TYPES.get(kind, "text")
    for item in metadata:
        if isinstance(item, WithJsonSchema) and item.json_schema:
            text = f"quantity such as `{item.json_schema['examples'][0]}`"
    limits = [
        f"{words} {limit:g}"
        for key, words in _BOUNDS.items()
        for item in metadata
        if (limit := getattr(item, key, None)) is not None
    ]
    in_unit = f"{text} in {unit}" if unit else text
    return ", ".join((in_unit, *([" and ".join(limits)] if limits else [])))
