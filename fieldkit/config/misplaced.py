"""Hints about keys of a YAML file at a wrong level, most likely because their line is indented wrongly."""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, get_args

from fieldkit.core.errors import did_you_mean

Fields = Mapping[str, Any]
"""Types by key of a mapping, from its model."""

_ALIKE: Final = 0.8
"""Similarity (`difflib`) from which a name counts as a misspelling of another."""
_DEEPEST: Final = 10
"""Maximum nesting of generic types that is searched."""


def hint(key: str, data: Mapping[Any, Any], fields: Fields, outer: Sequence[Fields]) -> tuple[str, int]:
    """Return a hint about an unknown key, and the enclosing mapping in which the key is valid.

    Args:
        key: The key.
        data: The mapping that contains it.
        fields: The valid keys of that mapping.
        outer: The valid keys of the enclosing mappings, the outermost first.

    Returns:
        The hint, and an index into `outer`, or -1 if the key is not valid in any of them.
    """
    preceding = list(data)[: list(data).index(key)]
    parents = [name for name, kind in fields.items() if any(key in keys for keys in _inner_keys(kind))]
    if parents:
        # A line with too little indentation most likely follows the mapping that it belongs to.
        name = next((name for name in reversed(preceding) if name in parents), parents[0])
        return f"it is a key of {name}: indent it below {name}:", -1
    for index in reversed(range(len(outer))):
        if key in outer[index]:
            return "", index
    valid = f"valid keys: {', '.join(fields)}"
    if preceding and _is_opaque_mapping(fields.get(preceding[-1])):
        similar = [f"did you mean {name!r}? " for name in difflib.get_close_matches(key, fields, n=1, cutoff=_ALIKE)]
        return (
            f"{''.join(similar) or f'{valid}; '}if it is a key of {preceding[-1]}, indent it below {preceding[-1]}:",
            -1,
        )
    return did_you_mean(key, fields, valid), -1


def _inner_keys(kind: Any, depth: int = 0) -> Iterator[Sequence[str]]:  # noqa: ANN401 (any type)
    """Yield the valid keys of each model that a type allows, without lists of mappings and mappings by name."""
    fields = getattr(kind, "model_fields", None)
    if fields is not None:
        yield [field.alias or name for name, field in fields.items()]
        return
    if getattr(kind, "__origin__", kind) in {list, tuple, dict} or depth == _DEEPEST:
        return
    for part in get_args(kind):
        yield from _inner_keys(part, depth + 1)


def _is_opaque_mapping(kind: Any) -> bool:  # noqa: ANN401 (any type)
    """Return True if a type is a mapping whose keys another package validates."""
    return any(get_args(part) == (str, object) for part in (kind, *get_args(kind)))
