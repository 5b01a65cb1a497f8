"""Values in what any program printed: at a path into its JSON, or by a regular expression.

What a robot says is not trusted, and expressions may be careless. Paths are JMESPath (jmespath.org/specification),
which has no loop but those over the data. Expressions are RE2 (github.com/google/re2/wiki/Syntax), which takes a time
that grows with the text alone: Python's own takes years for `(a+)+$` and forty letters.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any, Final

from fieldkit.core.columns import MISSING, Column, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import brief
from fieldkit.measure.evidence import reading

MOST_BYTES: Final = 1 << 20
"""What is kept of a program's output; one that prints more is cut."""

_TOO_DEEP: Final = "it is nested too deeply"


def problem_of_path(text: str) -> str | None:
    """Return why a text is no path into JSON, None where it is one."""
    try:
        _path(text)
    except ValueError as error:
        return " ".join(str(error).split())
    return None


def problem_of_expression(text: str) -> str | None:
    """Return why a text is no regular expression with one group, None where it is one."""
    try:
        groups = _expression(text).groups
    except ValueError as error:
        return str(error)
    return None if groups == 1 else f"it has {groups} groups, and the value is what the only one matches"


@cache
def _path(text: str) -> Any:  # noqa: ANN401 (jmespath declares no types)
    """Return a path; what is none is a ValueError, as jmespath's own are."""
    import jmespath  # noqa: PLC0415 (most commands see no path, and it takes 20 ms)

    try:
        return jmespath.compile(text)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error


@cache
def _expression(text: str) -> Any:  # noqa: ANN401 (re2 declares no types)
    """Return an expression; what is none is a ValueError."""
    import re2  # noqa: PLC0415 (as jmespath)

    options = re2.Options()
    options.log_errors = False
    try:
        return re2.compile(f"(?m){text}", options)
    except re2.error as error:
        said = error.args[0] if error.args else error
        raise ValueError(said.decode(errors="replace") if isinstance(said, bytes) else str(said)) from error


def text(path: Path) -> str:
    """Return what a program printed, bytes that are no UTF-8 replaced.

    Raises:
        EvidenceError: The file is missing, cannot be read, or holds all that is kept: there was more.
    """
    if reading.size(path) >= MOST_BYTES:
        raise EvidenceError(f"the program printed more than {MOST_BYTES >> 20} MiB", where=str(path))
    return reading.text(path)


def document(path: Path) -> object:
    """Return the JSON that a program printed.

    Raises:
        EvidenceError: As `text`, or it is none.
    """
    try:
        found: object = json.loads(text(path).removeprefix("\ufeff"))
    except (ValueError, RecursionError) as error:
        why = _TOO_DEEP if isinstance(error, RecursionError) else str(error)
        raise EvidenceError(f"is no JSON: {why}", where=str(path)) from error
    return found


def at_path(path: Path, where: str) -> object:
    """Return what stands at `where` in the JSON that a program printed; None where nothing does.

    Raises:
        EvidenceError: As `document`, or what stands there does not suit the functions that the path calls.
    """
    printed = document(path)
    try:
        found: object = _path(where).search(printed)
    except (ValueError, RecursionError) as error:
        why = _TOO_DEEP if isinstance(error, RecursionError) else " ".join(str(error).split())
        raise EvidenceError(why, where=str(path)) from error
    return found


def by_expression(path: Path, expression: str) -> object:
    """Return what the expression's group matches, where it matches first; None where it does not.

    Raises:
        EvidenceError: As `text`.
    """
    match = _expression(expression).search(text(path))
    return None if match is None else match[1]


def value(column: Column, found: object) -> Value:
    """Return what a program printed as a value of a column.

    Raises:
        EvidenceError: It is none: nothing at all, a list, words instead of a number.
    """
    if found is None:
        raise EvidenceError("there is none")
    if isinstance(found, list | dict):
        raise EvidenceError("it is not one value, but several")
    said = json.dumps(found) if isinstance(found, bool | int | float) else str(found).strip()
    shown = brief(said)
    if said in MISSING:
        raise EvidenceError("there is none")
    if column.type is str:
        return shown
    if isinstance(found, bool) != (column.type is bool) and not isinstance(found, str):
        raise EvidenceError(f"it is {shown}, of another type")
    if why := column.problem(said):
        raise EvidenceError(f"it is {shown!r}, {why}")
    if column.type is bool:
        return said.lower() in {"true", "1"}
    return float(said) if column.type is float else int(said) if said.lstrip("+-").isdigit() else int(float(said))
