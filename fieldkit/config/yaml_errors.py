"""Describe errors in YAML files for users, with hints about wrong indentation and without names of classes."""

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, get_args

from fieldkit.config.documents import Document, Location
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.units import format_count

Fields = Mapping[str, Any]
"""Type of the value by key of a mapping, from its model."""

_MIN_SIMILARITY: Final = 0.8
"""Minimum similarity (`difflib`) at which a name counts as a misspelling of another."""
_MAX_DEPTH: Final = 10
"""Maximum nesting of generic types that is searched."""


def misplaced_hint(key: str, data: Mapping[Any, Any], fields: Fields, outer: Sequence[Fields]) -> tuple[str, int]:
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
    valid = f"valid keys: {', '.join(fields)}" if fields else "no keys are valid here"
    if preceding and _is_opaque_mapping(fields.get(preceding[-1])):
        similar = [
            f"did you mean {name!r}? " for name in difflib.get_close_matches(key, fields, n=1, cutoff=_MIN_SIMILARITY)
        ]
        return (
            f"{''.join(similar) or f'{valid}; '}if it is a key of {preceding[-1]}, indent it below {preceding[-1]}:",
            -1,
        )
    return did_you_mean(key, fields, valid), -1


def _inner_keys(kind: Any, depth: int = 0) -> Iterator[Sequence[str]]:  # noqa: ANN401 (any type annotation)
    """Yield the valid keys of each model that a type allows; models in lists and in mappings by name are omitted."""
    fields = getattr(kind, "model_fields", None)
    if fields is not None:
        yield [field.alias or name for name, field in fields.items()]
        return
    if getattr(kind, "__origin__", kind) in {list, tuple, dict} or depth == _MAX_DEPTH:
        return
    for part in get_args(kind):
        yield from _inner_keys(part, depth + 1)


def _is_opaque_mapping(kind: Any) -> bool:  # noqa: ANN401 (any type annotation)
    """Return True if a type is a mapping whose keys another package validates."""
    return any(get_args(part) == (str, object) for part in (kind, *get_args(kind)))


_WORDS: Final = re.compile(r"\^\(([A-Za-z0-9_|]+)\)\$")
"""Matches the pattern of a key that allows only some words, such as `^(ros1|ros2)$`."""
_MAX_SHOWN: Final = 60
"""Maximum number of characters of a wrong text that a message shows."""
_NO_KEYS_HINT: Final = ", and there are none; indent the keys that belong to this line more than this line"
_MESSAGES: Final = MappingProxyType({"tuple_type": "a list is needed here", "missing": "this list needs more values"})


def explain(problems: Sequence[Any], document: Document, descriptions: Mapping[str, str]) -> ConfigurationError:
    """Return the error for the first problem in a document, with file, line and key path.

    Args:
        problems: All problems, as `ErrorDetails` of pydantic.
        document: The document.
        descriptions: Description of a valid text by pattern.
    """

    def line(problem: Any) -> int:  # noqa: ANN401 (an `ErrorDetails` of pydantic, which is not imported here)
        return int(document.where(_location(problem)).rsplit(":", 1)[1])

    problems = sorted(_without_cascading_errors(problems), key=line)
    first = problems[0]
    location = _location(first)
    place: Location = first["loc"]
    missing = _missing_key(first)
    if missing:
        message = f"required key {missing!r} is missing"
    elif place and place[-1] == "[key]":
        place, message = place[:-2], f"{place[-2]!r} cannot be a key here: {_message(first, descriptions)}"
    elif first.get("ctx", {}).get("outer"):
        message = _indentation_message(first, document)
    else:
        message = _message(first, descriptions)
    path = ".".join(str(part) for part in (*document.place, *document.existing_part(place)))
    remedy = f"add {missing}: to it" if missing else first.get("ctx", {}).get("remedy") or "correct this line"
    # A value with several valid forms has one problem per form at the same location.
    other_count = (
        len({(document.existing_part(_location(problem)), _missing_key(problem)) for problem in problems}) - 1
    )
    more = f" (and {format_count(other_count, 'more problem')})" if other_count else ""
    return ConfigurationError(
        f"{f'in {path}: ' if path else ''}{message}{more}",
        where=document.where(location),
        remedy=f"{remedy}; keys of every file: fieldkit docs reference",
    )


def _indentation_message(problem: Any, document: Document) -> str:  # noqa: ANN401 (an `ErrorDetails` of pydantic, which is not imported here)
    """Return the message for a key of an enclosing mapping, with the indentation of that mapping's keys."""
    place, context = problem["loc"], problem["ctx"]
    key, outer = context["key"], context["outer"]
    depth = max((depth for depth, part in enumerate(place) if part in outer), default=0)
    names = [part for part in document.existing_part(place[:depth]) if isinstance(part, str)]
    owner = f"of {names[-1]}" if names else "of the whole file"
    return f"unknown key {key} here; it is a key {owner}: indent it like {place[depth]}:"


def _missing_key(problem: Any) -> str:  # noqa: ANN401 (an `ErrorDetails` of pydantic, which is not imported here)
    """Return the key that a mapping lacks, or an empty string for another problem."""
    last = problem["loc"][-1] if problem["loc"] else None
    return last if problem["type"] == "missing" and isinstance(last, str) else ""


def _without_cascading_errors(problems: Sequence[Any]) -> list[Any]:
    """Return the problems, except those about lists that are too short only because of errors in their items."""

    def is_cascading(problem: Any) -> bool:  # noqa: ANN401 (an `ErrorDetails` of pydantic, which is not imported here)
        depth = len(problem["loc"])
        return problem["type"] == "too_short" and any(
            other["loc"][:depth] == problem["loc"] and len(other["loc"]) > depth for other in problems
        )

    return [problem for problem in problems if not is_cascading(problem)]


def _location(problem: Any) -> Location:  # noqa: ANN401 (an `ErrorDetails` of pydantic, which is not imported here)
    location: Location = problem["loc"]
    context = problem.get("ctx", {})
    key = context.get("key")
    return (*location, *context.get("at", ()), *(() if key is None else (key,)))


def _message(problem: Mapping[str, Any], descriptions: Mapping[str, str]) -> str:
    """Return the description of a problem, without its place."""
    message = _MESSAGES.get(problem["type"], problem["msg"])
    value, context = problem["input"], problem.get("ctx", {})
    match problem["type"]:
        case "model_type" | "dict_type":
            message = f"keys with values are needed here{_NO_KEYS_HINT * (value is None)}"
        case "value_error":
            message = str(context["error"])
        case "union_tag_not_found":
            message = f"required key {context['discriminator']} is missing"
        case "union_tag_invalid":
            kinds = re.findall(r"'([^']+)'", context["expected_tags"])
            message = (
                f"there is no kind {context['tag']!r}; {did_you_mean(context['tag'], kinds, _kinds_hint(kinds))}"
            )
        case "string_pattern_mismatch":
            message = _pattern_message(str(value), context["pattern"], descriptions)
        case "too_short":
            min_length, actual_length = context["min_length"], context["actual_length"]
            message = f"{actual_length} here, but at least {format_count(min_length, 'item')} must be given"
        case "literal_error" | "enum" if isinstance(value, str) and "'" in context["expected"]:
            message = _choice_message(value, re.findall(r"'([^']*)'", context["expected"]))
        case kind:
            message = _type_message(kind, message, value)
    return message


def _choice_message(text: str, choices: Sequence[str]) -> str:
    """Return the message about a text that is not one of the valid texts."""
    hint = did_you_mean(text, choices, "")
    return f"{_quoted(text)} is not one of: {', '.join(choices)}{f'; {hint}' if hint else ''}"


def _type_message(kind: str, message: str, value: object) -> str:
    """Return the message about a value whose type is wrong for its key; `message` for other kinds of problem."""
    match kind:
        case "string_type" if isinstance(value, bool | int | float):
            return f"{message}; put it in quotes"
        case "bool_type" if isinstance(value, str):
            return f"{message}; write true or false"
        case "int_type" if isinstance(value, str | float):
            return f"{value!r} is not a whole number; write it in digits only and without quotes"
        case "int_parsing" | "int_from_float":
            return f"{value!r} is not a whole number"
        case "float_parsing" | "float_type":
            return f"{value!r} is not a number; write it without a unit and without quotes"
    return message


def _kinds_hint(names: Sequence[str]) -> str:
    return f"kinds: {', '.join(names)}"


def _pattern_message(text: str, pattern: str, descriptions: Mapping[str, str]) -> str:
    """Return the message about a text that does not match a pattern."""
    if words := _WORDS.fullmatch(pattern):
        return _choice_message(text, words[1].split("|"))
    if pattern in descriptions:
        return f"{_quoted(text)} is not {descriptions[pattern]}"
    return f"{_quoted(text)} should match pattern {pattern!r}"


def _quoted(text: str) -> str:
    return repr(text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}...")
