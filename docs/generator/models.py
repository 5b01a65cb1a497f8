"""Tables of the keys of YAML files, from their pydantic models."""

import inspect
from collections.abc import Iterator
from enum import Enum
from typing import Annotated, Any, Literal, cast, get_args, get_origin

from pydantic import TypeAdapter
from pydantic.fields import FieldInfo

from docs.generator.markdown import relative, table
from fieldkit.config.documentation import attribute_meanings, class_description
from fieldkit.config.schema import Strict

HEAD = ("key", "default", "meaning")


def describe(model: type) -> str:
    """Return the description in the docstring of a model."""
    return relative(class_description(model))


def keys_table(model: type[Strict], prefix: str = "", without: frozenset[str] = frozenset()) -> str:
    """Return a table of every key of a file of `model`.

    Args:
        model: The model.
        prefix: Prefix of all keys.
        without: Prefixes of keys in another table.
    """
    return table(HEAD, (row for row in rows(model, prefix) if not row[0].strip("`").startswith(tuple(without))))


def rows(model: type[Strict], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield key, default and meaning of every key, nested keys after their parent."""
    meanings = attribute_meanings(model)
    for name, field in model.model_fields.items():
        key = field.alias or name
        # The name is searched first, because the alias may be the name of an attribute of a base class, such as
        # `Step.columns`.
        meaning = meanings.get(name) or meanings[key]
        yield f"`{prefix}{key}`", default(model, name), relative(meaning)
        if field.discriminator:
            continue  # each kind has a separate table
        for mark, inner in _models_in(field.annotation):
            yield from rows(inner, f"{prefix}{key}{mark}.")
    for key, section in model.section_types().items():
        yield f"`{prefix}{key}`", "none", " ".join(describe(section).split())
        if issubclass(section, Strict):
            yield from rows(section, f"{prefix}{key}.")


def _models_in(annotation: object) -> Iterator[tuple[str, type[Strict]]]:
    """Yield each model in an annotation, after the mark that its keys have: `[]` for a list, `.*` for a mapping."""
    if inspect.isclass(annotation) and issubclass(annotation, Strict):
        yield "", annotation
        return
    if any(isinstance(part, FieldInfo) and part.discriminator for part in get_args(annotation)):
        return
    origin = get_origin(annotation)
    mark = "[]" if origin is tuple else ".*" if origin is dict else ""
    for part in get_args(annotation):
        yield from ((mark + inner, model) for inner, model in _models_in(part))


def default(model: type[Strict], name: str) -> str:
    """Return the default of a field in the notation of a file, `required` or `none`."""
    field = model.model_fields[name]
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return "none"
    if isinstance(value, Strict):
        return "all defaults"
    # The alias is removed, because it has no meaning outside of its model.
    bare = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    adapter: TypeAdapter[Any] = TypeAdapter(cast("Any", bare))
    return f"`{_yaml(adapter.dump_python(value, mode='json'))}`"


def _yaml(value: object) -> str:
    """Return a scalar, list or mapping in YAML's flow style."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(_yaml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key}: {_yaml(item)}' for key, item in value.items())}}}"
    return '""' if value == "" else str(value)


def kinds(union: Any) -> dict[str, type[Strict]]:  # noqa: ANN401 (an annotated union of models)
    """Return the models of a discriminated union by their `kind`."""
    members = get_args(get_args(union)[0])
    return {_literal(model.model_fields["kind"].annotation): model for model in members}


def _literal(annotation: Any) -> str:  # noqa: ANN401 (as above)
    assert get_origin(annotation) is Literal
    (value,) = get_args(annotation)
    return str(value.value if isinstance(value, Enum) else value)
