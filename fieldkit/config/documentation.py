"""Documentation: the installed pages by topic, and descriptions of models and records from their docstrings.

Links in the descriptions are Markdown, relative to the folder `docs/`.
"""

import inspect
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError, did_you_mean

_PACKAGE: Final = Path(__file__).resolve().parents[1]
_FOLDERS: Final = ("", "reference", "studies")
_COMMANDS: Final = "commands"
"""The topic that describes all commands. Each command is also a topic."""


@dataclass(frozen=True)
class Page:
    """A page of the documentation.

    Attributes:
        path: File of the page.
        anchor: Identifier of a section; empty for the start of the page.
    """

    path: Path
    anchor: str = ""

    @property
    def uri(self) -> str:
        """Address for a browser."""
        return self.path.as_uri() + (f"#{self.anchor}" if self.anchor else "")


def topics() -> dict[str, Path]:
    """Return the file of every page by its name, sorted.

    Raises:
        ConfigurationError: This installation has no documentation.
    """
    installed = _PACKAGE / "data" / "docs"
    folder, suffix = (installed, "html") if installed.is_dir() else (_PACKAGE.parent / "docs", "md")
    pages: dict[str, Path] = {}
    for name in _FOLDERS:
        for path in sorted((folder / name).glob(f"*.{suffix}")):
            topic = name if name and path.stem == "index" else path.stem
            if topic != "404":
                pages.setdefault(topic, path)
    if "index" not in pages:
        raise ConfigurationError(
            "this installation has no documentation", remedy="pip install --force-reinstall fieldkit"
        )
    return dict(sorted(pages.items()))


def find(topic: str) -> Page:
    """Return the page of a topic; for a command, its section in the page of all commands.

    Raises:
        ConfigurationError: There is no such topic (the remedy contains the most similar one), or there is no
            documentation.
    """
    pages = topics()
    if topic in pages:
        return Page(pages[topic])
    heading = f"fieldkit-{topic}"
    reference = pages.get(_COMMANDS)
    if reference is not None and topic in _commands(reference):
        return Page(reference, heading)
    raise ConfigurationError(
        f"there is no topic {topic!r}", remedy=did_you_mean(topic, pages, "list all topics: fieldkit docs --list")
    )


def _commands(reference: Path) -> set[str]:
    """Return the names of the commands that a page describes, read from the page's links to their sections."""
    text = reference.read_text(encoding="utf-8")
    return {part.partition('"')[0].partition(")")[0] for part in text.split("#fieldkit-")[1:]}


_ENTRY: Final = re.compile(r"^    (?P<key>\w+): (?P<text>.*(?:\n {8}.*)*)", re.MULTILINE)
_LINK: Final = re.compile(r"\[([^\]]+)\]\([^)]+\)")


def class_description(model: type) -> str:
    """Return the docstring of a class without its `Attributes:`."""
    text = inspect.cleandoc(model.__doc__ or "")
    return text.partition("\n\nAttributes:")[0]


def attribute_meanings(model: type) -> dict[str, str]:
    """Return the meaning of each attribute, from the docstrings of the class and of its base classes."""
    meanings: dict[str, str] = {}
    for base in reversed(model.__mro__):
        text = inspect.cleandoc(base.__doc__ or "").partition("\n\nAttributes:")[2]
        meanings |= {match["key"]: " ".join(match["text"].split()) for match in _ENTRY.finditer(text)}
    return meanings


def without_links(text: str) -> str:
    """Return a text with each Markdown link replaced by its link text."""
    return _LINK.sub(r"\1", text)
