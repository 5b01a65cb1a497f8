"""Checks the links of a built site: each target must be a file of the site, and each anchor must exist in it."""

from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

_TARGETS: Final = ("href", "src")
_LINK_ELEMENTS: Final = {"a"}
"""Elements that load nothing until the user clicks on them."""


@dataclass(frozen=True)
class Page:
    """The links of a page, as pairs of element and target, and its anchors."""

    links: list[tuple[str, str]] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)


class _LinkParser(HTMLParser):
    def __init__(self, page: Page) -> None:
        super().__init__()
        self._page = page

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self._page.links.extend((tag, target) for name in _TARGETS if (target := values.get(name)))
        self._page.anchors.update(value for name in ("id", "name") if (value := values.get(name)))


def read(path: Path) -> Page:
    """The links and anchors of an HTML file."""
    page = Page()
    _LinkParser(page).feed(path.read_text(encoding="utf-8"))
    return page


def broken_links(site: Path) -> list[str]:
    """All broken links of a site, and all resources that a page loads from other sites."""
    pages = {path.resolve(): read(path) for path in site.rglob("*.html") if path.name != "404.html"}
    problems = []
    for path, page in pages.items():
        for tag, link in page.links:
            url = urlsplit(link)
            if url.scheme or url.netloc:
                if tag not in _LINK_ELEMENTS and url.scheme != "data":
                    problems.append(f"{path.relative_to(site.resolve())} loads {link}")
                continue
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            anchors = pages[target].anchors if target in pages else {url.fragment}
            if not target.is_file() or (url.fragment and unquote(url.fragment) not in anchors):
                problems.append(f"{path.relative_to(site.resolve())}: {link}")
    return problems
