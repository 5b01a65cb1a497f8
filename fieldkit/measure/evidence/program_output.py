"""Extraction of a value from a program's output: by a path into JSON, or by a regular expression.

Output of a robot is not trusted, and expressions can be inefficient. Paths are JMESPath (jmespath.org/specification),
which has no loops except over the data. Expressions are RE2 (github.com/google/re2/wiki/Syntax): matching takes a
time that is linear in the length of the text. Python's `re` needs years to match `(a+)+$` with some texts of fifty
letters.
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
"""Maximum size of a program's output; the robot discards the output beyond it."""

_TOO_DEEP: Final = "it is nested too deeply"


def path_error(text: str) -> str | None:
    """Return the reason why a text is not a JMESPath, or None if it is one."""
    try:
        _compile_path(text)
    except ValueError as error:
        return " ".join(str(error).split())
    return None


def expression_error(text: str) -> str | None:
    """Return the reason why a text is not a regular expression with one group, or None if it is one."""
    try:
        groups = _compile_expression(text).groups
    except ValueError as error:
        return str(error)
    return None if groups == 1 else f"it has {groups} groups, but must have exactly one, which matches the value"


@cache
def _compile_path(text: str) -> Any:  # noqa: ANN401 (jmespath declares no types)
    """Return a compiled path; raises ValueError, like jmespath, if the text is not a path."""
    import jmespath  # noqa: PLC0415 (takes 20 ms, and most commands need no path)

    try:
        return jmespath.compile(text)
    except RecursionError as error:
        raise ValueError(_TOO_DEEP) from error


@cache
def _compile_expression(text: str) -> Any:  # noqa: ANN401 (re2 declares no types)
    """Return a compiled expression; raises ValueError if the text is not a regular expression."""
    import re2  # noqa: PLC0415 (an optional package, and most commands need no expression)

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
        EvidenceError: The file is missing, cannot be read, or has the maximum size, because output was discarded.
    """
    if reading.size(path) >= MAX_OUTPUT_BYTES:
        raise EvidenceError(f"the program printed more than {MAX_OUTPUT_BYTES >> 20} MiB", where=str(path))
    return reading.text(path)


def document(path: Path) -> object:
    """Return the parsed JSON that a program printed.

    Raises:
        EvidenceError: For the same reasons as `text`, or because the output is not JSON.
    """
    try:
        return parse_json(text(path))
    except ValueError as error:
        raise EvidenceError(str(error), where=str(path)) from error


def parse_json(output: str) -> object:
    """Return the parsed JSON of a text; raises ValueError with the reason if the text is not JSON."""
    try:
        parsed: object = json.loads(output.removeprefix("\ufeff"))
    except (ValueError, RecursionError) as error:
        reason = _TOO_DEEP if isinstance(error, RecursionError) else str(error)
        raise ValueError(f"is not JSON: {reason}") from error
    return parsed


def at_path(path: Path, where: str) -> object:
    """Return the value at the path `where` in the JSON that a program printed, or None if there is no value.

    Raises:
        EvidenceError: For the same reasons as `document`, or because a function in the path was applied to a value
            of the wrong type.
    """
    printed = document(path)
    try:
        return search_json(printed, where)
    except ValueError as error:
        raise EvidenceError(str(error), where=str(path)) from error


def search_json(printed: object, where: str) -> object:
    """Return the value at the path `where` in parsed JSON, or None if there is no value.

    Raises:
        ValueError: A function in the path was applied to a value of the wrong type, or the JSON is nested too deeply.
    """
    try:
        result: object = _compile_path(where).search(printed)
    except (ValueError, RecursionError) as error:
        reason = _TOO_DEEP if isinstance(error, RecursionError) else " ".join(str(error).split())
        raise ValueError(reason) from error
    return result


def by_expression(path: Path, expression: str) -> object:
    """Return the text that the expression's group first matches in a program's output, or None without a match.

    Raises:
        EvidenceError: For the same reasons as `text`.
    """
    return search_text(text(path), expression)


def search_text(output: str, expression: str) -> str | None:
    """Return the part of a text that the expression's group first matches, or None without a match."""
    match = _compile_expression(expression).search(output)
    group: str | None = None if match is None else match[1]
    return group


def to_column_value(column: Column, extracted: object) -> Value:
    """Convert an extracted value to a value of a column.

    Raises:
        EvidenceError: The value is missing, a list or an object, or has another type than the column.
    """
    if extracted is None:
        raise EvidenceError("the value is missing")
    if isinstance(extracted, list | dict):
        raise EvidenceError("it is a list or an object instead of a single value")
    text = json.dumps(extracted) if isinstance(extracted, bool | int | float) else str(extracted).strip()
    shortened = shorten(text)
    if text in MISSING:
        raise EvidenceError("the value is missing")
    if column.type is str:
        return shortened
    if isinstance(extracted, bool) != (column.type is bool) and not isinstance(extracted, str):
        raise EvidenceError(f"it is {shortened}, which has another type than the column")
    if reason := column.invalid_value_reason(text):
        raise EvidenceError(f"it is {shortened!r}, {reason}")
    if column.type is bool:
        return text.lower() in {"true", "1"}
    if column.type is float:
        return float(text)
    return int(text) if text.lstrip("+-").isdigit() else int(float(text))  # the text may be 1e3
