"""Descriptions of models and records, read from their docstrings for the reference and for editors.

Links in them are Markdown, relative to the folder `docs/`.
"""

import inspect
import re
from typing import Final

_ENTRY: Final = re.compile(r"^    (?P<key>\w+): (?P<text>.*(?:\n {8}.*)*)", re.MULTILINE)
_LINK: Final = re.compile(r"\[([^\]]+)\]\([^)]+\)")


def description(model: type) -> str:
    """Return the docstring of a class without its `Attributes:`."""
    text = inspect.cleandoc(model.__doc__ or "")
    return text.partition("\n\nAttributes:")[0]


def attributes(model: type) -> dict[str, str]:
    """Return the meaning of each attribute, from the docstrings of the class and of its base classes."""
    meanings: dict[str, str] = {}
    for base in reversed(model.__mro__):
        text = inspect.cleandoc(base.__doc__ or "").partition("\n\nAttributes:")[2]
        meanings |= {match["key"]: " ".join(match["text"].split()) for match in _ENTRY.finditer(text)}
    return meanings


def without_links(text: str) -> str:
    """Return a text with each Markdown link replaced by its link text."""
    return _LINK.sub(r"\1", text)
