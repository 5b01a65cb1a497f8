"""The page: one HTML file that opens without a network. The only user of jinja2."""

import os
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from fieldkit import __version__
from fieldkit.analysis.wording import counts, label
from fieldkit.core.text import harmless
from fieldkit.report import figures, svg, theme, wording
from fieldkit.report.charts import Panel
from fieldkit.report.contents import Contents

_TEMPLATE: Final = "report.html"


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
    environment.filters["link"] = partial(_link, base=out.absolute().parent)
    environment.globals |= {
        "panel_svg": _Panels(),
        "counts": counts,
        "label": label,
        "wording": wording,
        "version": __version__,
        "light": theme.variables(theme.LIGHT),
        "dark": theme.variables(theme.DARK),
        "shapes": theme.SHAPES,
        "dashes": theme.DASHES,
    }
    return environment.get_template(_TEMPLATE).render(contents=contents)


def _link(target: Path, *, base: Path) -> str:
    """Return the link from a page in the folder `base` to evidence; it works where both are copied together."""
    relative = os.path.relpath(target, base)
    return quote(relative + "/" if target.is_dir() else relative)


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
