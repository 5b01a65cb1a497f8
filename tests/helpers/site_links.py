"""Links of a built site: every target is a file in it, and every anchor exists there."""

from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

_TARGETS: Final = ("href", "src")
_OPENED: Final = {"a"}
"""Elements that load nothing before somebody clicks on them."""


@dataclass(frozen=True)
class Page:
    """The links of a page, each with its element, and its anchors."""

    links: list[tuple[str, str]] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)


class _Reader(HTMLParser):
    def __init__(self, page: Page) -> None:
        super().__init__()
        self._page = page

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self._page.links.extend((tag, target) for name in _TARGETS if (target := values.get(name)))
        self._page.anchors.update(value for name in ("id", "name") if (value := values.get(name)))


def read(path: Path) -> Page:
    """Return links and anchors of an HTML file."""
    page = Page()
    _Reader(page).feed(path.read_text(encoding="utf-8"))
    return page


def broken(site: Path) -> list[str]:
    """Return every link of a site that leads nowhere, and everything that a page loads from elsewhere."""
    pages = {path.resolve(): read(path) for path in site.rglob("*.html") if path.name != "404.html"}
    problems = []
    for path, page in pages.items():
        for tag, link in page.links:
            url = urlsplit(link)
            if url.scheme or url.netloc:
                if tag not in _OPENED and url.scheme != "data":
                    problems.append(f"{path.relative_to(site.resolve())} loads {link}")
                continue
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            anchors = pages[target].anchors if target in pages else {url.fragment}
            if not target.is_file() or (url.fragment and unquote(url.fragment) not in anchors):
                problems.append(f"{path.relative_to(site.resolve())}: {link}")
    return problems
