"""Text of unknown origin made safe to show, and what reading it may raise.

Every output goes through `harmless`, or through `json_text` where it is JSON: tables, CSV, Markdown, LaTeX, JUnit,
the report's HTML, and all that is printed. `tests/e2e/test_hostile_text.py` lists the outputs.
"""

import json
import re
from typing import Any, Final

JSON_ERRORS: Final = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)
"""What reading JSON that somebody else wrote may raise: it is none, is of other types than it is to be, holds a
number that no float holds, or is nested too deep for Python."""


_FORMULA: Final = re.compile(r"'*[=+@-].")
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


def harmless(text: str) -> str:
    """Return `text` with a `?` for each character that is not printable.

    These are control characters of C0 and C1, which start terminal escapes; format characters, of which some turn the
    direction of writing; separators of lines and paragraphs; and halves of surrogate pairs. Line feeds and no-break
    spaces stay.
    """
    return "\n".join(line if line.isprintable() else _replaced(line) for line in text.split("\n"))


def _replaced(line: str) -> str:
    return "".join(char if char.isprintable() or char == "\N{NO-BREAK SPACE}" else "?" for char in line)


def one_line(text: str) -> str:
    """Return `text` as one line without control characters, as a cell of a table holds it."""
    return harmless(" ".join(text.splitlines()))


def json_text(value: Any, **options: Any) -> str:  # noqa: ANN401 (any JSON value; options of `json.dumps`)
    """Return a value as JSON in which every character that is not printable is escaped; a reader gets all of them."""
    lines = json.dumps(value, ensure_ascii=False, **options).split("\n")
    return "\n".join(line if line.isprintable() else "".join(map(_escaped, line)) for line in lines)


def _escaped(char: str) -> str:
    """Return a character as JSON escapes it: beyond 16 bits as a surrogate pair (RFC 8259, section 7)."""
    if char.isprintable() or char == "\N{NO-BREAK SPACE}":
        return char
    return json.dumps(char)[1:-1] if ord(char) != 0x7F else "\\u007f"


def guarded(text: str) -> str:
    """Return a text as a CSV cell that no spreadsheet takes for a formula: with a `'` before `=`, `+`, `-` or `@`.

    Numbers stay as they are. `unguarded` takes the `'` away, so that a table that is read again has the same values.
    See OWASP, "CSV Injection".
    """
    return f"'{text}" if _FORMULA.match(text) and not _NUMBER.fullmatch(text) else text


def unguarded(text: str) -> str:
    """Return the text of which `guarded` made a cell."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def brief(text: str, most: int = 200) -> str:
    """Return `text` as one line of at most so many characters, a `?` for each that nobody sees."""
    return "".join(char if char.isprintable() else "?" for char in " ".join(text.split())[:most])


def encodable(text: str) -> str:
    """Return `text` as a file takes it: a `?` for each half of a surrogate pair, as names that are no UTF-8 hold."""
    return text.encode(errors="replace").decode()
