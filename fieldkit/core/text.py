"""Plain text: sanitize text of unknown origin, print it, and list the exceptions of reading untrusted JSON."""

import json
import re
import sys
from typing import Any, Final

JSON_ERRORS: Final = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)
"""Exceptions that reading untrusted JSON can raise: invalid JSON, unexpected types, a number that is too large for a
float, or nesting that is too deep for Python."""


# If a text already has quotes before the formula, another quote is added, so that `unescape_formula` is the inverse.
_FORMULA: Final = re.compile(r"'*[=+@-].")
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


def sanitized(text: str) -> str:
    """Return `text` with a `?` for each character that is not printable.

    Characters that are not printable are the control characters C0 and C1 (they start terminal escapes), format
    characters (some of them change the text direction), line and paragraph separators, and unpaired surrogates. Line
    feeds and no-break spaces are kept.
    """
    return "\n".join(line if line.isprintable() else _replace_unprintable(line) for line in text.split("\n"))


def _replace_unprintable(line: str) -> str:
    return "".join(char if char.isprintable() or char == "\N{NO-BREAK SPACE}" else "?" for char in line)


def one_line(text: str) -> str:
    """Return `text` as one line without control characters, for a cell of a table."""
    return sanitized(" ".join(text.splitlines()))


def json_text(value: Any, **options: Any) -> str:  # noqa: ANN401 (any JSON value; options of `json.dumps`)
    """Return a value as JSON in which all unprintable characters are escaped, so that no character is lost."""
    lines = json.dumps(value, ensure_ascii=False, **options).split("\n")
    return "\n".join(line if line.isprintable() else "".join(map(_json_escape, line)) for line in lines)


def _json_escape(char: str) -> str:
    """Return the JSON escape of an unprintable character, as a surrogate pair above 16 bits (RFC 8259, section 7)."""
    if char.isprintable() or char == "\N{NO-BREAK SPACE}":
        return char
    return json.dumps(char)[1:-1] if ord(char) != 0x7F else "\\u007f"


def escape_formula(text: str) -> str:
    """Return a text as a CSV cell that no spreadsheet reads as a formula: with a `'` before `=`, `+`, `-` or `@`.

    Numbers are unchanged. `unescape_formula` removes the `'`, so that reading the table again gives the same values.
    See OWASP, "CSV Injection".
    """
    return f"'{text}" if _FORMULA.match(text) and not _NUMBER.fullmatch(text) else text


def unescape_formula(text: str) -> str:
    """Return the original text of a cell that `escape_formula` returned."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def shorten(text: str, max_length: int = 200) -> str:
    """Return `text` as one line of at most `max_length` characters, with a `?` for each unprintable one."""
    return "".join(char if char.isprintable() else "?" for char in " ".join(text.split())[:max_length])


def encodable(text: str) -> str:
    """Return `text` with a `?` for each unpaired surrogate, so that it can be written as UTF-8.

    Python uses unpaired surrogates for the bytes of file names that are not UTF-8.
    """
    return text.encode(errors="replace").decode()


def print_text(text: object = "", *, end: str = "\n", flush: bool = False) -> None:
    """Print a text with its control characters replaced, except tabs, which may be part of a shown file."""
    sys.stdout.write("\t".join(map(sanitized, str(text).split("\t"))) + end)
    if flush:
        sys.stdout.flush()
