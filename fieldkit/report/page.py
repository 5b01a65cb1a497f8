"""The page: one HTML file that opens without a network. The only user of jinja2."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from fieldkit import __version__
from fieldkit.analysis.wording import counts
from fieldkit.report import figures, svg, theme, wording
from fieldkit.report.charts import Panel
from fieldkit.report.contents import Contents
from fieldkit.text import harmless

_TEMPLATE: Final = "report.html"


@dataclass(frozen=True)
class Links:
    """Relative links from the page to raw evidence, which work when both are copied together.

    Attributes:
        base: Folder of the page.
    """

    base: Path

    def to(self, target: Path) -> str:
        """Return the link to a file or folder."""
        relative = os.path.relpath(target, self.base)
        return quote(relative + "/" if target.is_dir() else relative)


def render(contents: Contents, out: Path) -> str:
    """Return the page as HTML.

    Args:
        contents: What stands in it.
        out: Where it will be written: links to evidence begin there.
    """
    environment = Environment(
        loader=PackageLoader("fieldkit.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalized,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["link"] = Links(out.absolute().parent).to
    environment.globals |= {
        "panel_svg": _Panels(),
        "counts": counts,
        "wording": wording,
        "version": __version__,
        "light": theme.variables(theme.LIGHT),
        "dark": theme.variables(theme.DARK),
        "shapes": theme.SHAPES,
        "dashes": theme.DASHES,
    }
    return environment.get_template(_TEMPLATE).render(contents=contents)


def _finalized(value: Any) -> Any:  # noqa: ANN401 (whatever stands in the template)
    """Return what stands in the page for a value: nothing from evidence keeps control characters."""
    return harmless(value) if type(value) is str else value


class _Panels:
    """Draws panels, each with ids of its own."""

    def __init__(self) -> None:
        self._drawn = 0

    def __call__(self, panel: Panel) -> str:
        self._drawn += 1
        return svg.inline(figures.panel_svg(panel), f"p{self._drawn}-", panel.words)
