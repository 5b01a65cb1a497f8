"""Extraction of a value from a program's output: by a path into JSON, or by a regular expression.

Output of a robot is not trusted, and expressions can be inefficient. Paths are JMESPath (jmespath.org/specification),
whose only loops are over the data. Expressions are RE2 (github.com/google/re2/wiki/Syntax), whose time is linear in
the length of the text; Python's `re` needs years to match `(a+)+$` with some texts of forty letters.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any, Final

from fieldkit.core.columns import MISSING, Column, Value
from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import shorten
from fieldkit.measure.evidence import reading

MAX_OUTPUT_BYTES: Final = 1 << 20
"""Maximum size of a program's output; the rest is discarded on the robot."""

_TOO_DEEP: Final = "it is nested too deeply"


def path_error(text: str) -> str | None:
    """Return the reason why a text is not a path into JSON, or None if it is."""
    try:
        _compile_path(text)
    except ValueError as error:
        return " ".join(str(error).split())
    return None


def expression_error(text: str) -> str | None:
    """Return the reason why a text is not a regular expression with one group, or None if it is."""
    try:
        groups = _compile_expression(text).groups
    except ValueError as error:
        return str(error)
    return None if groups == 1 else f"it has {groups} groups, but must have exactly one, which matches the value"


@cache
def _compile_path(text: str) -> Any:  # noqa: ANN401 (jmespath declares no types)
    """Return a compiled path; raises ValueError, like jmespath, for any other text."""
    import jmespath  # noqa: PLC0415 (takes 20 ms, and most commands need no path)

    try:
        return jmespath.compile(text)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error


@cache
def _compile_expression(text: str) -> Any:  # noqa: ANN401 (re2 declares no types)
    """Return a compiled expression; raises ValueError for any other text."""
    import re2  # noqa: PLC0415 (as jmespath)

    options = re2.Options()
    options.log_errors = False
    try:
        return re2.compile(f"(?m){text}", options)
    except re2.error as error:
        message = error.args[0] if error.args else error
        raise ValueError(message.decode(errors="replace") if isinstance(message, bytes) else str(message)) from error


def text(path: Path) -> str:
    """Return the output of a program; bytes that are not UTF-8 are replaced.

    Raises:
        EvidenceError: The file is missing, cannot be read, or has the maximum size, so that output was discarded.
    """
    if reading.size(path) >= MAX_OUTPUT_BYTES:
        raise EvidenceError(f"the program printed more than {MAX_OUTPUT_BYTES >> 20} MiB", where=str(path))
    return reading.text(path)


def document(path: Path) -> object:
    """Return the value of the JSON that a program printed.

    Raises:
        EvidenceError: As `text`, or the output is not JSON.
    """
    try:
        return parse_json(text(path))
    except ValueError as error:
        raise EvidenceError(str(error), where=str(path)) from error


def parse_json(output: str) -> object:
    """Return the value of JSON text; raises ValueError with the reason if it is not JSON."""
    try:
        parsed: object = json.loads(output.removeprefix("\ufeff"))
    except (ValueError, RecursionError) as error:
        reason = _TOO_DEEP if isinstance(error, RecursionError) else str(error)
        raise ValueError(f"is not JSON: {reason}") from error
    return parsed


def at_path(path: Path, where: str) -> object:
    """Return the value at the path `where` in the JSON that a program printed; None if there is none.

    Raises:
        EvidenceError: As `document`, or a function in the path was applied to a value of the wrong type.
    """
    printed = document(path)
    try:
        return search_json(printed, where)
    except ValueError as error:
        raise EvidenceError(str(error), where=str(path)) from error


def search_json(printed: object, where: str) -> object:
    """Return the value at the path `where` in a JSON value; None if there is none.

    Raises:
        ValueError: A function in the path was applied to a value of the wrong type, or it is nested too deeply.
    """
    try:
        result: object = _compile_path(where).search(printed)
    except (ValueError, RecursionError) as error:
        reason = _TOO_DEEP if isinstance(error, RecursionError) else " ".join(str(error).split())
        raise ValueError(reason) from error
    return result


def by_expression(path: Path, expression: str) -> object:
    """Return the text of the expression's group in its first match; None if it does not match.

    Raises:
        EvidenceError: As `text`.
    """
    return search_text(text(path), expression)


def search_text(output: str, expression: str) -> str | None:
    """Return the text of the expression's group in its first match in a text; None if it does not match."""
    match = _compile_expression(expression).search(output)
    group: str | None = None if match is None else match[1]
    return group


def value(column: Column, extracted: object) -> Value:
    """Convert an extracted value to a value of a column.

    Raises:
        EvidenceError: It is not a value of the column: missing, a list, or a text instead of a number.
    """
    if extracted is None:
        raise EvidenceError("the value is missing")
    if isinstance(extracted, list | dict):
        raise EvidenceError("it is not one value, but several")
    text = json.dumps(extracted) if isinstance(extracted, bool | int | float) else str(extracted).strip()
    shown = shorten(text)
    if text in MISSING:
        raise EvidenceError("the value is missing")
    if column.type is str:
        return shown
    if isinstance(extracted, bool) != (column.type is bool) and not isinstance(extracted, str):
        raise EvidenceError(f"it is {shown}, which has another type than the column")
    if reason := column.invalid_value_reason(text):
        raise EvidenceError(f"it is {shown!r}, {reason}")
    if column.type is bool:
        return text.lower() in {"true", "1"}
    return float(text) if column.type is float else int(text) if text.lstrip("+-").isdigit() else int(float(text))
