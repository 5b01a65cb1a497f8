"""Text that somebody else wrote, made fit to be shown, and what reading it may raise."""

from typing import Final

JSON_ERRORS: Final = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)
"""What reading JSON that somebody else wrote may raise: it is none, is of other types than it is to be, holds a
number that no float holds, or is nested too deep for Python."""


def harmless(text: str) -> str:
    """Return `text` without what moves a cursor, rings, colours, or turns the direction of writing: each a `?`.

    Line ends and no-break spaces stay.
    """
    return "".join(char if char.isprintable() or char in "\n\N{NO-BREAK SPACE}" else "?" for char in text)


def brief(text: str, most: int = 200) -> str:
    """Return `text` as one line of at most so many characters, a `?` for each that nobody sees."""
    return "".join(char if char.isprintable() else "?" for char in " ".join(text.split())[:most])


def encodable(text: str) -> str:
    """Return `text` as a file takes it: a `?` for each half of a surrogate pair, as names that are no UTF-8 hold."""
    return text.encode(errors="replace").decode()
