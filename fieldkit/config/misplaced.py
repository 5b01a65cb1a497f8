"""Keys of a YAML file that are known, but at another level: most likely their line is indented wrongly."""

import difflib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, get_args

from fieldkit.core.errors import nearest

Fields = Mapping[str, Any]
"""Type by the key of a mapping, as its model declares it."""

_ALIKE: Final = 0.8
"""How alike two names are (`difflib`) of which one is most likely a typing error."""
_DEEPEST: Final = 10
"""How deep generic types are looked into."""


def hint(key: str, data: Mapping[Any, Any], fields: Fields, outer: Sequence[Fields]) -> tuple[str, int]:
    """Return what to do about an unknown key, and of which mapping around it the key is.

    Args:
        key: The key.
        data: The mapping in which it is.
        fields: The keys that are known there.
        outer: The keys of the mappings around it, the outermost first.

    Returns:
        The hint, and an index into `outer`; -1 where the key is of none of them.
    """
    before = list(data)[: list(data).index(key)]
    below = [name for name, kind in fields.items() if any(key in known for known in _inside(kind))]
    if below:
        # A line that is indented too little most likely follows the mapping to which it belongs.
        name = next((name for name in reversed(before) if name in below), below[0])
        return f"it is a key of {name}: indent it below {name}:", -1
    for index in reversed(range(len(outer))):
        if key in outer[index]:
            return "", index
    valid = f"valid keys: {', '.join(fields)}"
    if before and _is_open(fields.get(before[-1])):
        near = [f"did you mean {name!r}? " for name in difflib.get_close_matches(key, fields, n=1, cutoff=_ALIKE)]
        return f"{''.join(near) or f'{valid}; '}if it is a key of {before[-1]}, indent it below {before[-1]}:", -1
    return nearest(key, fields, valid), -1


def _inside(kind: Any, depth: int = 0) -> Iterator[Sequence[str]]:  # noqa: ANN401 (any type)
    """Yield the keys of each model that a value of a type can be, lists of mappings and mappings by name apart."""
    fields = getattr(kind, "model_fields", None)
    if fields is not None:
        yield [field.alias or name for name, field in fields.items()]
        return
    if getattr(kind, "__origin__", kind) in {list, tuple, dict} or depth == _DEEPEST:
        return
    for part in get_args(kind):
        yield from _inside(part, depth + 1)


def _is_open(kind: Any) -> bool:  # noqa: ANN401 (any type)
    """Return whether a type is a mapping, or none, with keys that somebody else knows."""
    return any(get_args(part) == (str, object) for part in (kind, *get_args(kind)))
