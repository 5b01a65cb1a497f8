"""What is wrong with a YAML file, as somebody can use it who knows YAML, but no classes."""

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

from fieldkit.config.documents import Document, Location
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.units import format_count

SHAPES: Final[dict[str, str]] = {}
"""What texts of a pattern are in words; whoever declares one says it, see `schema.shaped`."""

_WORDS: Final = re.compile(r"\^\(([A-Za-z0-9_|]+)\)\$")
_SHOWN: Final = 60
_NOTHING: Final = ", and nothing stands here; keys that belong to this line are indented more than it is"
_SAID: Final = MappingProxyType({"tuple_type": "a list is needed here", "missing": "this list needs more values"})


def explain(found: Sequence[Any], document: Document) -> ConfigurationError:
    """Return the first problem in a document, with file, line and key path.

    Args:
        found: All problems, pydantic's own `ErrorDetails`.
        document: The document.
    """

    def line(problem: Any) -> int:  # noqa: ANN401 (as `found`)
        return int(document.where(_location(problem)).rsplit(":", 1)[1])

    problems = sorted(_told_once(found), key=line)
    first = problems[0]
    location = _location(first)
    place: Location = first["loc"]
    missing = _missing_key(first)
    if missing:
        message = f"required key {missing!r} is missing"
    elif place and place[-1] == "[key]":
        place, message = place[:-2], f"{place[-2]!r} cannot be a key here: {_worded(first)}"
    elif first.get("ctx", {}).get("outer"):
        message = _too_far_in(first, document)
    else:
        message = _worded(first)
    path = ".".join(str(part) for part in (*document.place, *document.known(place)))
    remedy = f"add {missing}: to it" if missing else "mend this line"
    # Of what may have several forms each says what is wrong, and the place is one.
    others = len({(document.known(_location(one)), _missing_key(one)) for one in problems}) - 1
    more = f" ({others} more after this one)" if others else ""
    return ConfigurationError(
        f"{f'in {path}: ' if path else ''}{message}{more}",
        where=document.where(location),
        remedy=f"{remedy}; keys of every file: fieldkit docs reference",
    )


def _too_far_in(problem: Any, document: Document) -> str:  # noqa: ANN401 (as in `explain`)
    """Return that a key is of a mapping around the one in which it is, and how that mapping's keys are indented."""
    place, context = problem["loc"], problem["ctx"]
    key, outer = context["key"], context["outer"]
    depth = max((depth for depth, part in enumerate(place) if part in outer), default=0)
    names = [part for part in document.known(place[:depth]) if isinstance(part, str)]
    of = f"of {names[-1]}" if names else "of the whole file"
    return f"unknown key {key} here; it is a key {of}: indent it as {place[depth]}: is"


def _missing_key(problem: Any) -> str:  # noqa: ANN401 (as in `explain`)
    """Return the key that a mapping lacks; nothing where that is not the problem."""
    last = problem["loc"][-1] if problem["loc"] else None
    return last if problem["type"] == "missing" and isinstance(last, str) else ""


def _told_once(found: Sequence[Any]) -> list[Any]:
    """Return the problems without lists that are too short because what is wrong in them was not counted."""

    def is_echo(one: Any) -> bool:  # noqa: ANN401 (as `found`)
        depth = len(one["loc"])
        return one["type"] == "too_short" and any(
            other["loc"][:depth] == one["loc"] and len(other["loc"]) > depth for other in found
        )

    return [one for one in found if not is_echo(one)]


def _location(problem: Any) -> Location:  # noqa: ANN401 (as in `explain`)
    location: Location = problem["loc"]
    context = problem.get("ctx", {})
    key = context.get("key")
    return (*location, *context.get("at", ()), *(() if key is None else (key,)))


def _worded(problem: Mapping[str, Any]) -> str:
    message: str = _SAID.get(problem["type"], problem["msg"])
    found, context = problem["input"], problem.get("ctx", {})
    match problem["type"]:
        case "model_type" | "dict_type":
            message = f"keys with values are needed here{_NOTHING * (found is None)}"
        case "value_error":
            message = str(context["error"])
        case "union_tag_not_found":
            message = f"required key {context['discriminator']} is missing"
        case "union_tag_invalid":
            known = re.findall(r"'([^']+)'", context["expected_tags"])
            message = f"there is no kind {context['tag']!r}; {nearest(context['tag'], known, _kinds(known))}"
        case "string_pattern_mismatch":
            message = _misshapen(str(found), context["pattern"])
        case "too_short":
            least, short = context["min_length"], context["actual_length"]
            message = f"at least {format_count(least, 'item')} must stand here, not {short}"
        case "string_type" if isinstance(found, bool | int | float):
            message = f"{message}; put it in quotes"
        case "bool_type" if isinstance(found, str):
            message = f"{message}; write true or false"
        case "int_type" if isinstance(found, str):
            message = f"{message}, in digits alone and without quotes"
    return message


def _kinds(known: Sequence[str]) -> str:
    return f"kinds: {', '.join(known)}"


def _misshapen(text: str, pattern: str) -> str:
    """Return why a text does not match a pattern."""
    shown = repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")
    if words := _WORDS.fullmatch(pattern):
        known = words[1].split("|")
        return f"{shown} is none of these: {', '.join(known)}"
    if pattern in SHAPES:
        return f"{shown} is not {SHAPES[pattern]}"
    return f"{shown} should match pattern {pattern!r}"
