"""`for:` in lists of steps: what stands inside is written out once for each value, when a file is read.

    - for:
        each: {bytes: [502, 1400]}
        during:
          - ping: {name: "p{bytes}", from: sender, to: receiver, payload_bytes: "{bytes}"}

Of several variables every combination is written out, the last one changing fastest. A text that is nothing but
`{bytes}` becomes the value itself; `{{` and `}}` stand for braces.
"""

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from fieldkit.config.documents import Document, Location
from fieldkit.core.errors import ConfigurationError, nearest

MOST: Final = 1000
"""Steps that a file may be written out to."""

_LOOP: Final = "for"
_KEYS: Final = ("each", "during")
_VARIABLE: Final = re.compile(r"[a-z][a-z0-9_]{0,30}")
_BRACES: Final = re.compile(r"\{\{|\}\}|\{(?P<name>[a-z][a-z0-9_]{0,30})\}")

Scalar = str | int | float | bool
Values = Mapping[str, Scalar]
"""Value by variable."""


def written_out(document: Document, key: str) -> Document:
    """Return a document with every `for:` written out; each value keeps the line that it came from.

    Args:
        document: A mapping, of which nothing is known yet.
        key: Of its list of steps.

    Raises:
        ConfigurationError: A `for:` is not as it must be, names no such variable, or makes too many steps.
    """
    if not isinstance(document.data, dict) or not isinstance(document.data.get(key), list):
        return document  # whoever validates it says what is wrong
    writer = _Writer(document)
    steps = writer.steps(document.data[key], (key,), (key,), {})
    others = {place: line for place, line in document.lines.items() if place[:1] != (key,) or place == (key,)}
    return replace(document, data={**document.data, key: steps}, lines={**others, **writer.lines})


class _Writer:
    """Writes out one document.

    Args:
        document: The document.

    Attributes:
        lines: Line of each value that is written, by its new place.
    """

    def __init__(self, document: Document) -> None:
        self.lines: dict[Location, int] = {}
        self._document = document
        self._steps = 0

    def steps(self, items: list[Any], at: Location, to: Location, values: Values) -> list[Any]:
        """Return a list of steps written out.

        Args:
            items: The list.
            at: Its place in the document.
            to: Its new place.
            values: Of the variables there.
        """
        made: list[Any] = []
        self._note(at, to)
        self._into(made, items, at, to, values)
        return made

    def _into(self, made: list[Any], items: list[Any], at: Location, to: Location, values: Values) -> None:
        for index, item in enumerate(items):
            here = (*at, index)
            if isinstance(item, dict) and _LOOP in item:
                if len(item) > 1:
                    raise self._problem("for: stands alone in its entry", here, "begin another entry with - for:")
                self._repeated(made, item[_LOOP], (*here, _LOOP), to, values)
                continue
            self._steps += 1
            if self._steps > MOST:
                raise self._problem(
                    f"there are more than {MOST} steps, all for: written out", here, "give fewer values"
                )
            made.append(self._copy(item, here, (*to, len(made)), values))

    def _repeated(self, made: list[Any], loop: Any, at: Location, to: Location, values: Values) -> None:  # noqa: ANN401 (any YAML)
        if not isinstance(loop, dict) or set(loop) != set(_KEYS):
            unknown = [key for key in loop if key not in _KEYS] if isinstance(loop, dict) else []
            what = f"unknown key {unknown[0]} in for:" if unknown else "for: needs each: and during:"
            raise self._problem(what, (*at, *unknown[:1]), "for: {each: {bytes: [502, 1400]}, during: [...]}")
        if not isinstance(loop["during"], list) or not loop["during"]:
            raise self._problem("during: of for: is no list of steps", (*at, "during"), "write the steps to repeat")
        variables = self._variables(loop["each"], (*at, "each"), values)
        if (times := math.prod(map(len, variables.values()))) > MOST:
            raise self._problem(
                f"for: has {times} combinations, more than {MOST}", (*at, "each"), "give fewer values"
            )
        for chosen in itertools.product(*variables.values()):
            inside = {**values, **dict(zip(variables, chosen, strict=True))}
            self._into(made, loop["during"], (*at, "during"), to, inside)

    def _variables(self, each: Any, at: Location, outer: Values) -> dict[str, list[Scalar]]:  # noqa: ANN401 (any YAML)
        """Return the values of each variable of a loop."""
        if not isinstance(each, dict) or not each:
            raise self._problem("each: of for: names no variable", at, "each: {bytes: [502, 1400]}")
        found: dict[str, list[Scalar]] = {}
        for name, listed in each.items():
            here = (*at, name)
            if not _VARIABLE.fullmatch(name):
                raise self._problem(f"{name!r} cannot be a variable", here, "use small letters, digits and _")
            if name in outer:
                raise self._problem(f"{name} is a variable of a for: around this one", here, "give it another name")
            if not isinstance(listed, list) or not listed:
                raise self._problem(f"the values of {name} are no list", here, f"{name}: [1, 2]")
            found[name] = [
                self._copy(item, (*here, index), (*here, index), outer) for index, item in enumerate(listed)
            ]
            for index, value in enumerate(found[name]):
                if not isinstance(value, Scalar):
                    raise self._problem(f"a value of {name} is no text or number", (*here, index), f"{name}: [1, 2]")
        return found

    def _copy(self, value: Any, at: Location, to: Location, values: Values) -> Any:  # noqa: ANN401 (any YAML)
        """Return a value with variables filled in, noting its lines."""
        self._note(at, to)
        match value:
            case dict():
                if unquoted := [key for key, item in value.items() if item is None and key in values]:
                    what = f"without quotes YAML takes {{{unquoted[0]}}} for a mapping"
                    raise self._problem(what, at, f'put it in quotes: "{{{unquoted[0]}}}"')
                return {
                    key: (self.steps if key == "during" and isinstance(item, list) else self._copy)(
                        item, (*at, key), (*to, key), values
                    )
                    for key, item in value.items()
                }
            case list():
                return [self._copy(item, (*at, index), (*to, index), values) for index, item in enumerate(value)]
            case str() if values:
                return self._filled(value, at, values)
        return value

    def _note(self, at: Location, to: Location) -> None:
        """Note the line of what is written to a place."""
        if at in self._document.lines:
            self.lines[to] = self._document.lines[at]

    def _filled(self, text: str, at: Location, values: Values) -> Scalar:
        """Return a text with variables filled in; the value itself where it is nothing but one of them."""

        def value_of(match: re.Match[str]) -> Scalar:
            if (name := match["name"]) is None:
                return match[0][0]
            if name not in values:
                known = nearest(name, values, f"here are: {', '.join(values)}")
                remedy = f"write {{{{{name}}}}} for the text {{{name}}}, or name a variable"
                raise self._problem(f"there is no variable {name}; {known}", at, remedy)
            return values[name]

        if (whole := _BRACES.fullmatch(text)) is not None:
            return value_of(whole)
        return _BRACES.sub(lambda match: _in_text(value_of(match)), text)

    def _problem(self, what: str, at: Location, remedy: str) -> ConfigurationError:
        return ConfigurationError(what, where=self._document.where(at), remedy=remedy)


def _in_text(value: Scalar) -> str:
    """Return a value as YAML writes it."""
    return str(value).lower() if isinstance(value, bool) else str(value)
