"""The page of a report: one HTML file that contains its figures and opens without a network.

This is the only module that imports jinja2.
"""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote
from xml.etree import ElementTree as ET

from jinja2 import Environment, PackageLoader, StrictUndefined

from fieldkit import __version__
from fieldkit.analysis.wording import counts, label, tally
from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError, shell_command
from fieldkit.core.text import sanitized
from fieldkit.report import figures, theme, wording
from fieldkit.report.charts import Panel
from fieldkit.report.contents import Contents

DEFAULT_NAME: Final = "report.html"
_FIRST_BYTES: Final = b"<!DOCTYPE html>"
"""First bytes of a report. A file that begins with other bytes is not overwritten."""
_TEMPLATE: Final = "report.html"
_SVG_NAMESPACE: Final = "http://www.w3.org/2000/svg"
_XLINK_NAMESPACE: Final = "http://www.w3.org/1999/xlink"
_XLINK_HREF: Final = f"{{{_XLINK_NAMESPACE}}}href"
# The style is the same in all figures, and the page defines it.
_REMOVED_TAGS: Final = frozenset((f"{{{_SVG_NAMESPACE}}}metadata", f"{{{_SVG_NAMESPACE}}}style"))
# Coordinates are in points. Decimals after the second are invisible, but make up half of the page's size.
_GEOMETRY_ATTRIBUTES: Final = frozenset(("d", "x", "y", "width", "height", "transform"))
_DECIMALS: Final = re.compile(r"(\.\d{2})\d+")
_OTHER_FORMATS: Final = frozenset({".csv", ".json", ".md", ".pdf", ".png", ".svg", ".tex"})
"""Suffixes of files that programs would not open as a page."""
_LOCAL_URL: Final = re.compile(r"url\(#")

ET.register_namespace("", _SVG_NAMESPACE)
ET.register_namespace("xlink", _XLINK_NAMESPACE)


def write(contents: Contents, out: Path) -> None:
    """Write the page. Raises the same errors as `explaining_write_errors`."""
    with explaining_write_errors(out, "-o"):
        files.write(out, render(contents, out).encode())


def require_writable(out: Path) -> None:
    """Check, before a report is computed, that its page may be written to `out`.

    Only a report or an empty file may be overwritten. Permissions are not checked.

    Raises:
        ConfigurationError: The page cannot be written there, or the suffix is that of another format.
    """
    if not out.parent.is_dir():
        raise ConfigurationError(
            "there is no such folder", where=str(out.parent), remedy=shell_command("mkdir", "-p", out.parent)
        )
    if out.is_dir():
        raise ConfigurationError(
            "this is a folder", where=str(out), remedy=f"name a file: {shell_command('-o', out / DEFAULT_NAME)}"
        )
    if out.exists() and not _is_page(out):
        raise ConfigurationError(
            "this file is not a report, and is not overwritten",
            where=str(out),
            remedy="choose another -o",
        )
    if out.suffix.lower() in _OTHER_FORMATS:
        raise ConfigurationError(
            "a report is a page of HTML",
            where=str(out),
            remedy=f"name a file: {shell_command('-o', out.with_suffix('.html'))}; for figures --figures FOLDER",
        )


def _is_page(out: Path) -> bool:
    """Return True if a regular file is a report or empty. Others, such as a pipe, are not read: that could block."""
    if not out.is_file():
        return False
    with explaining_write_errors(out, "-o"), out.open("rb") as file:
        return file.read(len(_FIRST_BYTES)) in {b"", _FIRST_BYTES}


@contextmanager
def explaining_write_errors(path: Path, option: str) -> Iterator[None]:
    """Raise a ConfigurationError with the path and the option if the body of the `with` statement raises OSError."""
    try:
        yield
    except OSError as error:
        raise ConfigurationError(
            f"cannot be written: {error.strerror}", where=str(path), remedy=f"choose another {option}"
        ) from error


def render(contents: Contents, out: Path) -> str:
    """Return the page as HTML.

    Args:
        contents: Its contents.
        out: Path of the page; links to evidence are relative to its folder.
    """
    environment = Environment(
        loader=PackageLoader("fieldkit.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_without_control_characters,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["link"] = partial(_link, base=out.absolute().parent)
    environment.globals |= {
        "panel_svg": _Panels(),
        "counts": counts,
        "label": label,
        "tally": tally,
        "wording": wording,
        "version": __version__,
        "light": theme.variables(theme.LIGHT),
        "dark": theme.variables(theme.DARK),
        "shapes": theme.SHAPES,
        "dashes": theme.DASHES,
    }
    return environment.get_template(_TEMPLATE).render(contents=contents)


def _link(target: Path, *, base: Path) -> str:
    """Return the link from a page in the folder `base` to evidence. It remains valid if both are copied together."""
    relative = os.path.relpath(target, base)
    return quote(relative + "/" if target.is_dir() else relative)


def _without_control_characters(value: Any) -> Any:  # noqa: ANN401 (any value in the template)
    """Return a value for the page, with control characters of texts replaced."""
    return sanitized(value) if type(value) is str else value


class _Panels:
    """Draws panels, each with unique ids."""

    def __init__(self) -> None:
        self._count = 0

    def __call__(self, panel: Panel) -> str:
        self._count += 1
        return inline_svg(figures.panel_svg(panel), f"p{self._count}-", panel.description)


def inline_svg(document: str, prefix: str, description: str) -> str:
    """Return an SVG document as an element of a page.

    Its colours become variables of the page, its width is flexible, and its ids start with `prefix` to be unique.

    Args:
        document: An SVG document, as `figures.panel_svg` returns it.
        prefix: A prefix that is different for each document of a page.
        description: Description for screen readers.
    """
    root = ET.fromstring(document)  # noqa: S314 (made by matplotlib, so it is trusted)
    for parent in list(root.iter()):
        for child in list(parent):
            if child.tag in _REMOVED_TAGS:
                parent.remove(child)
    for element in root.iter():
        for name, value in list(element.items()):
            element.set(name, _attribute(name, value, prefix))
    for name in ("width", "height"):
        del root.attrib[name]
    root.set("role", "img")
    root.set("aria-label", sanitized(description))
    return ET.tostring(root, encoding="unicode")


def _attribute(name: str, value: str, prefix: str) -> str:
    """Return the value of an attribute of an SVG element for the page; see `inline_svg`."""
    if name == "id":
        return prefix + value
    if name == _XLINK_HREF:
        return f"#{prefix}{value.removeprefix('#')}"
    if name in _GEOMETRY_ATTRIBUTES:
        return _DECIMALS.sub(r"\1", value)
    return theme.use_variables(_LOCAL_URL.sub(f"url(#{prefix}", value))
