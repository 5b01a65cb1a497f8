"""Expansion of `for:` in lists of steps: when a file is read, the steps are repeated for each value.

    - for:
        each: {bytes: [502, 1400]}
        during:
          - ping: {name: "p{bytes}", from: sender, to: receiver, payload_bytes: "{bytes}"}

With several variables the steps are repeated for every combination, with the last variable changing fastest. A text
that consists only of `{bytes}` becomes the value itself, with its type; `{{` and `}}` are literal braces.
"""

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from fieldkit.config.documents import Document, Location
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import LOOP, MAX_STEPS

_KEYS: Final = ("each", "during")
_VARIABLE: Final = re.compile(r"[a-z][a-z0-9_]{0,30}")
_BRACES: Final = re.compile(r"\{\{|\}\}|\{(?P<name>[a-z][a-z0-9_]{0,30})\}")

Scalar = str | int | float | bool
Values = Mapping[str, Scalar]
"""Values by variable."""


def expand_loops(document: Document, key: str) -> Document:
    """Return a document with every `for:` expanded; each value keeps its line.

    Args:
        document: A document that has not been validated.
        key: The key of its list of steps.

    Raises:
        ConfigurationError: A `for:` is not valid, uses an unknown variable, or results in too many steps.
    """
    if not isinstance(document.data, dict) or not isinstance(document.data.get(key), list):
        return document  # validation reports the error
    expander = _Expander(document)
    steps = expander.expand_steps(document.data[key], (key,), (key,), {})
    other_lines = {place: line for place, line in document.lines.items() if place[:1] != (key,) or place == (key,)}
    return replace(document, data={**document.data, key: steps}, lines={**other_lines, **expander.lines})


class _Expander:
    """Expands the loops of one document.

    Args:
        document: The document.

    Attributes:
        lines: Line of each value of the result, by its new location.
    """

    def __init__(self, document: Document) -> None:
        self.lines: dict[Location, int] = {}
        self._document = document
        self._step_count = 0

    def expand_steps(self, items: list[Any], location: Location, new_location: Location, values: Values) -> list[Any]:
        """Return a list of steps with its loops expanded.

        Args:
            items: The list.
            location: Location of the list in the document.
            new_location: Location of the list in the result.
            values: Values of the variables of the enclosing loops.
        """
        result: list[Any] = []
        self._copy_line(location, new_location)
        self._append(result, items, location, new_location, values)
        return result

    def _append(
        self, result: list[Any], items: list[Any], location: Location, new_location: Location, values: Values
    ) -> None:
        """Append a list of steps to `result` with its loops expanded; see `expand_steps` for the other arguments."""
        for index, item in enumerate(items):
            key_path = (*location, index)
            if isinstance(item, dict) and LOOP in item:
                if len(item) > 1:
                    raise self._error(
                        "for: must be the only key of its entry", key_path, "start another entry with - for:"
                    )
                self._append_loop(result, item[LOOP], (*key_path, LOOP), new_location, values)
                continue
            self._step_count += 1
            if self._step_count > MAX_STEPS:
                raise self._error(
                    f"there are more than {MAX_STEPS} steps after for: is expanded", key_path, "give fewer values"
                )
            result.append(self._copy(item, key_path, (*new_location, len(result)), values))

    def _append_loop(
        self,
        result: list[Any],
        loop: Any,  # noqa: ANN401 (any YAML)
        location: Location,
        new_location: Location,
        values: Values,
    ) -> None:
        """Append the steps of a loop to `result`, for each combination of its values."""
        if not isinstance(loop, dict) or set(loop) != set(_KEYS):
            unknown = [key for key in loop if key not in _KEYS] if isinstance(loop, dict) else []
            what = f"unknown key {unknown[0]} in for:" if unknown else "for: needs each: and during:"
            raise self._error(what, (*location, *unknown[:1]), "for: {each: {bytes: [502, 1400]}, during: [...]}")
        if not isinstance(loop["during"], list) or not loop["during"]:
            raise self._error(
                "during: of for: is not a list of steps", (*location, "during"), "write the steps to repeat"
            )
        variables = self._read_variables(loop["each"], (*location, "each"), values)
        if (count := math.prod(map(len, variables.values()))) > MAX_STEPS:
            raise self._error(
                f"for: has {count} combinations, more than {MAX_STEPS}", (*location, "each"), "give fewer values"
            )
        for combination in itertools.product(*variables.values()):
            inner_values = {**values, **dict(zip(variables, combination, strict=True))}
            self._append(result, loop["during"], (*location, "during"), new_location, inner_values)

    def _read_variables(self, each: Any, location: Location, outer: Values) -> dict[str, list[Scalar]]:  # noqa: ANN401 (any YAML)
        """Return the values of each variable of a loop."""
        if not isinstance(each, dict) or not each:
            raise self._error("each: of for: has no variable", location, "each: {bytes: [502, 1400]}")
        values_by_name: dict[str, list[Scalar]] = {}
        for name, value_list in each.items():
            key_path = (*location, name)
            if not _VARIABLE.fullmatch(name):
                raise self._error(
                    f"{name!r} is not a valid variable", key_path, "use lower-case letters, digits and _"
                )
            if name in outer:
                raise self._error(f"{name} is a variable of an enclosing for:", key_path, "give it another name")
            if not isinstance(value_list, list) or not value_list:
                raise self._error(f"the values of {name} are not a list", key_path, f"{name}: [1, 2]")
            values_by_name[name] = [
                self._copy(item, (*key_path, index), (*key_path, index), outer)
                for index, item in enumerate(value_list)
            ]
            for index, value in enumerate(values_by_name[name]):
                if not isinstance(value, Scalar):
                    raise self._error(
                        f"a value of {name} is not a text or a number", (*key_path, index), f"{name}: [1, 2]"
                    )
        return values_by_name

    def _copy(self, value: Any, location: Location, new_location: Location, values: Values) -> Any:  # noqa: ANN401 (any YAML)
        """Return a value with its variables substituted, and store the lines of its parts."""
        self._copy_line(location, new_location)
        match value:
            case dict():
                if unquoted := [key for key, item in value.items() if item is None and key in values]:
                    what = f"without quotes YAML reads {{{unquoted[0]}}} as a mapping"
                    raise self._error(what, location, f'put it in quotes: "{{{unquoted[0]}}}"')
                return {
                    key: (self.expand_steps if key == "during" and isinstance(item, list) else self._copy)(
                        item, (*location, key), (*new_location, key), values
                    )
                    for key, item in value.items()
                }
            case list():
                return [
                    self._copy(item, (*location, index), (*new_location, index), values)
                    for index, item in enumerate(value)
                ]
            case str() if values:
                return self._substitute(value, location, values)
        return value

    def _copy_line(self, location: Location, new_location: Location) -> None:
        """Store the line of a location in the document as the line of its location in the result."""
        if location in self._document.lines:
            self.lines[new_location] = self._document.lines[location]

    def _substitute(self, text: str, location: Location, values: Values) -> Scalar:
        """Return a text with variables substituted. A text that consists only of one variable becomes its value."""

        def matched_value(match: re.Match[str]) -> Scalar:
            if (name := match["name"]) is None:
                return match[0][0]
            if name not in values:
                suggestion = did_you_mean(name, values, f"the variables are: {', '.join(values)}")
                remedy = f"write {{{{{name}}}}} for the text {{{name}}}, or use a variable"
                raise self._error(f"there is no variable {name}; {suggestion}", location, remedy)
            return values[name]

        if (only_variable := _BRACES.fullmatch(text)) is not None:
            return matched_value(only_variable)
        return _BRACES.sub(lambda match: _yaml_text(matched_value(match)), text)

    def _error(self, what: str, location: Location, remedy: str) -> ConfigurationError:
        return ConfigurationError(what, where=self._document.where(location), remedy=remedy)


def _yaml_text(value: Scalar) -> str:
    """Return a value in the notation of YAML."""
    return str(value).lower() if isinstance(value, bool) else str(value)
