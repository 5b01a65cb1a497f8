"""Fields of parsed JSON from a robot, each checked for its type before use."""

import math
from collections.abc import Mapping
from typing import Any, Final

_MAX_COUNT: Final = 2**53


def mapping(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the object under a key; an empty one if there is no object."""
    value = document.get(key)
    return value if isinstance(value, dict) else {}


def items(document: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    """Return the objects of the list under a key; an empty list if there is no list."""
    value = document.get(key)
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def number(document: Mapping[str, Any], key: str) -> float | None:
    """Return the number under a key; None if it is missing, not finite, negative, or not below 2**53."""
    value = document.get(key)
    fits = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < _MAX_COUNT
    return float(value) if fits and value is not None and math.isfinite(value) else None


def count(document: Mapping[str, Any], key: str) -> int | None:
    """Return the number under a key as an integer; None under the conditions of `number`."""
    value = number(document, key)
    return None if value is None else int(value)
