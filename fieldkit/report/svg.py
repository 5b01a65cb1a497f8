"""SVG documents made fit to stand inside one HTML page."""

import re
from typing import Final
from xml.etree import ElementTree as ET

from fieldkit.core.text import harmless
from fieldkit.report.theme import themed

_SVG: Final = "http://www.w3.org/2000/svg"
_XLINK: Final = "http://www.w3.org/1999/xlink"
_HREF: Final = f"{{{_XLINK}}}href"
# The style is the same in all, and the page's own.
_DROPPED: Final = frozenset((f"{{{_SVG}}}metadata", f"{{{_SVG}}}style"))
# A hundredth of a point is nothing that anybody sees, and half of the page.
_GEOMETRY: Final = frozenset(("d", "x", "y", "width", "height", "transform"))
_DECIMALS: Final = re.compile(r"(\.\d{2})\d+")
_LOCAL_URL: Final = re.compile(r"url\(#")

ET.register_namespace("", _SVG)
ET.register_namespace("xlink", _XLINK)


def inline(document: str, prefix: str, words: str) -> str:
    """Return an SVG document as an element of a page.

    Its colours become the page's, its width is free, its ids begin with `prefix`, for those of a page are unique.

    Args:
        document: As `figures.panel_svg` returns it.
        prefix: Different for each document of a page.
        words: What it shows, for those who cannot see it.
    """
    root = ET.fromstring(document)  # noqa: S314 (matplotlib's, not a stranger's)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in _DROPPED:
                parent.remove(child)
    for element in root.iter():
        for name, value in list(element.items()):
            element.set(name, _attribute(name, value, prefix))
    for name in ("width", "height"):
        del root.attrib[name]
    root.set("role", "img")
    root.set("aria-label", harmless(words))
    return ET.tostring(root, encoding="unicode")


def _attribute(name: str, value: str, prefix: str) -> str:
    if name == "id":
        return prefix + value
    if name == _HREF:
        return f"#{prefix}{value.removeprefix('#')}"
    if name in _GEOMETRY:
        return _DECIMALS.sub(r"\1", value)
    return themed(_LOCAL_URL.sub(f"url(#{prefix}", value))
