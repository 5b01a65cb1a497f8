"""The installed documentation: its pages by topic.

A wheel contains the site as HTML. In a source checkout, where the site is not built, the pages are Markdown.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from fieldkit.core.errors import ConfigurationError, did_you_mean

_PACKAGE: Final = Path(__file__).resolve().parents[1]
_FOLDERS: Final = ("", "reference", "studies")
_COMMANDS: Final = "commands"
"""The topic that describes all commands; a command is a topic too."""


@dataclass(frozen=True)
class Page:
    """A page of the documentation.

    Attributes:
        path: Its file.
        anchor: The section in it; empty for the start of the page.
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
        ConfigurationError: There is no such topic (the nearest is given), or no documentation.
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
