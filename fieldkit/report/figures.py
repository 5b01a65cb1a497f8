"""Draw charts with matplotlib, which no other module imports: the same bytes whenever and wherever."""

import io
import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any, Final, Literal

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import CARETUP
from matplotlib.ticker import FormatStrFormatter, MaxNLocator, NullFormatter

from fieldkit.core import files
from fieldkit.core.text import harmless
from fieldkit.lab.protocol import Overview
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.theme import FORMATS, LIGHT, METADATA, SETTINGS, Colour, Format, Style

_MARKER: Final = 5.0
_POINT: Final = 3.0
"""Size of markers that stand in a crowd."""
_FAINT: Final = 0.3
"""Opacity of single repeats behind what they come to."""
_STEPS: Final = (1, 2, 5, 10)
"""Of the ticks of an axis."""
_TITLE: Final = 48
_TICK: Final = 20
"""Letters for which there is room."""
_PANEL_INCHES: Final = (4.4, 2.75)
# What IEEE asks for: one column of 3.5 in or both, 7.16 in, and 8 pt for what stands in figures.
_COLUMN_INCHES: Final = 3.5
_BOTH_COLUMNS_INCHES: Final = 7.16
_PAPER_PANEL_INCHES: Final = 2.3

_MATERIALS: Final[dict[str, Colour]] = {"foliage": "green", "wood": "orange", "brick": "red", "ground": "orange"}
"""Colours of obstacles that are not grey."""
_SNR_DB: Final = (0.0, 60.0)
"""From where next to nothing arrives to more than any mode needs: equal colours in all figures."""
_BACKED: Final = {"facecolor": LIGHT["paper"], "edgecolor": "none", "pad": 0.5}
_EDGE: Final = 0.15
"""Share of the world next to its edge, where labels turn inwards."""

_FEW_LINKS: Final = 15
"""So many links can have their SNR beside them: those of six robots."""
_LONG_LINK: Final = 0.1
"""Share of the drawing's width from which on a link has room for it."""


def panel_svg(panel: Panel) -> str:
    """Return one panel as an SVG document for the page: no background, text as text, colours of the light theme."""
    with _drawing(9.0):
        figure = Figure(figsize=_PANEL_INCHES, layout="constrained")
        _draw(figure.add_subplot(), panel)
        return _saved(figure, "svg", transparent=True).decode()


def paper(chart: Chart, form: Format) -> bytes:
    """Return a whole chart with its legend, in the width of a paper's column, or of both for several panels."""
    columns = min(2, len(chart.panels))
    rows = -(-len(chart.panels) // columns)
    width = _COLUMN_INCHES if columns == 1 else _BOTH_COLUMNS_INCHES
    with _drawing(8.0):
        figure = Figure(figsize=(width, _PAPER_PANEL_INCHES * rows + 0.3), layout="constrained")
        for number, panel in enumerate(chart.panels, start=1):
            _draw(figure.add_subplot(rows, columns, number), panel)
        if chart.legend:
            handles = [_handle(label, style) for label, style in chart.legend.items()]
            figure.legend(handles=handles, loc="outside upper center", ncols=min(4, len(handles)))
        return _saved(figure, form, transparent=False)


def save(charts: Iterable[Chart], folder: Path) -> Iterator[Path]:
    """Write charts as `paper` draws them, each in every format, yielding the files.

    Args:
        charts: What to draw.
        folder: Where to; it is there.

    Raises:
        OSError: A file cannot be written.
    """
    for chart in charts:
        for form in FORMATS:
            path = folder / f"{chart.name}.{form}"
            files.write(path, paper(chart, form))
            yield path


def overview(lab: Overview, form: Format) -> bytes:
    """Return a lab from above: what stands in it, the robots, and their links coloured by SNR; broken ones dotted."""
    with _drawing(8.0):
        figure = Figure(figsize=(_BOTH_COLUMNS_INCHES, _BOTH_COLUMNS_INCHES * 0.75), layout="constrained")
        axes = figure.add_subplot()
        axes.set_title(harmless(f"{lab.world}, {len(lab.robots)} robots"), wrap=True)
        axes.set(
            xlim=(0, lab.area_m[0]), ylim=(0, lab.area_m[1]), aspect="equal", xlabel="east (m)", ylabel="north (m)"
        )
        for outline in lab.outlines:
            axes.fill(
                *zip(*outline.corners, strict=True),
                color=LIGHT[_MATERIALS.get(outline.material, "muted")],
                alpha=0.45,
            )
        if lab.links:
            _draw_links(figure, axes, lab)
        east_m, north_m = zip(*lab.robots.values(), strict=True)
        axes.plot(east_m, north_m, "o", color=LIGHT["ink"], markersize=_MARKER, zorder=4, clip_on=False)
        for name, place_m in lab.robots.items():
            # Away from the links, which are in the middle, but not out of the world.
            share = place_m[1] / lab.area_m[1]
            above = share < _EDGE or (place_m[1] >= fmean(north_m) and share <= 1 - _EDGE)
            axes.annotate(
                harmless(name),
                place_m,
                (0, 4 if above else -4),
                textcoords="offset points",
                fontsize=5,
                ha=_side(place_m[0], lab.area_m[0]),
                va="bottom" if above else "top",
                zorder=5,
            )
        return _saved(figure, form, transparent=False)


def _side(east_m: float, width_m: float) -> Literal["left", "center", "right"]:
    """Return how a label is aligned at a place, so that it does not leave the world."""
    share = east_m / width_m
    return "left" if share < _EDGE else "right" if share > 1 - _EDGE else "center"


def _draw_links(figure: Figure, axes: Axes, lab: Overview) -> None:
    lines = [[lab.robots[end] for end in link.ends] for link in lab.links]
    drawn = LineCollection(
        lines,
        array=[link.snr_db for link in lab.links],
        cmap="viridis",
        linestyles=["solid" if link.linked else "dotted" for link in lab.links],
        linewidths=1.2 if len(lines) <= _FEW_LINKS else 0.4,
        zorder=2,
    )
    drawn.set_clim(*_SNR_DB)
    axes.add_collection(drawn)
    figure.colorbar(drawn, ax=axes, label="SNR (dB)", shrink=0.7)
    for (place_m, other_m), link in zip(lines, lab.links, strict=True):
        if len(lines) <= _FEW_LINKS and math.dist(place_m, other_m) > _LONG_LINK * max(lab.area_m):
            middle_m = (place_m[0] + other_m[0]) / 2, (place_m[1] + other_m[1]) / 2
            axes.annotate(
                harmless(", ".join((f"{link.snr_db:.0f} dB", *link.through))),
                middle_m,
                fontsize=5,
                ha=_side(middle_m[0], lab.area_m[0]),
                va="center",
                zorder=3,
                bbox=_BACKED,
            )


@contextmanager
def _drawing(points: float) -> Iterator[None]:
    with mpl.rc_context(), warnings.catch_warnings():
        # What a user's matplotlibrc says must not change a byte.
        mpl.rcdefaults()
        mpl.rcParams.update(SETTINGS | {"font.size": points, "axes.titlesize": points, "axes.labelsize": points})
        # A letter that DejaVu lacks is still text in SVG, and a box elsewhere.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def _saved(figure: Figure, form: Format, *, transparent: bool) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format=form, metadata=METADATA[form], transparent=transparent)
    return out.getvalue()


def _draw(axes: Axes, panel: Panel) -> None:
    axes.set_title(_fitting(panel.title, _TITLE))
    axes.set_xlabel(_fitting(panel.x_label, _TITLE))
    axes.set_ylabel(_fitting(panel.y_label, _TITLE))
    for series in panel.series:
        if len(series.x):  # matplotlib would make room for an empty one, at the corner of the figure
            _draw_series(axes, series, math.inf if panel.top is None else panel.top)
    for span in panel.spans:
        axes.barh(span.lane, span.stop - span.start, left=span.start, height=0.6, color=LIGHT[span.colour])
    if panel.lanes:
        axes.set_yticks(range(len(panel.lanes)), [_fitting(lane, _TICK) for lane in panel.lanes])
        axes.set_ylim(-0.6, len(panel.lanes) - 0.4)
        axes.grid(visible=False, axis="y")
    else:
        axes.set_ylim(panel.bottom, panel.top)
    if panel.log:
        axes.set_yscale("log")
        # Powers of ten are formulas otherwise, which text is no more.
        axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    elif not panel.lanes:
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=_STEPS))
    if panel.right is not None:
        axes.set_xlim(panel.left, panel.right)
    if panel.x_ticks:
        axes.set_xticks([at for at, _ in panel.x_ticks], [_fitting(label, _TICK) for _, label in panel.x_ticks])
        axes.grid(visible=False, axis="x")
    else:
        axes.xaxis.set_major_locator(MaxNLocator(nbins=6, steps=_STEPS))


def _draw_series(axes: Axes, series: Series, top: float) -> None:
    look = _look(series.style)
    if series.join == "steps":
        axes.step(series.x, series.y, where="post", **look)
        return
    colour = look["color"]
    if series.behind:
        shown = [(x, y) for x, y in series.behind if y <= top]
        faint = {"color": colour, "alpha": _FAINT, "markersize": _POINT, "markeredgewidth": 0}
        axes.plot([x for x, _ in shown], [y for _, y in shown], "o", **faint)
    axes.plot(series.x, series.y, clip_on=False, **(look | {"linestyle": "none"} if series.join == "none" else look))
    for x, y, low, high in zip(series.x, series.y, series.low, series.high, strict=False):
        if low is not None and high is not None:
            # At nothing lost the interval only says how few repeats there are: it must not outshine what was seen.
            axes.vlines(
                x, low, min(high, top), color=colour, linewidth=1.1, linestyles="-" if y != 0 else (0, (1, 4))
            )
            if high > top:
                axes.plot(x, top, marker=CARETUP, color=colour, markersize=_MARKER, clip_on=False)


def _fitting(text: str, most: int) -> str:
    said = harmless(text)
    return said if len(said) <= most else f"{said[: most - 1]}…"


def _handle(label: str, style: Style) -> Line2D:
    return Line2D([], [], label=_fitting(label, _TITLE), **_look(style))


def _look(style: Style) -> dict[str, Any]:
    colour = LIGHT[style.colour]
    return {
        "color": colour,
        "marker": style.marker or None,
        "markerfacecolor": LIGHT["paper"] if style.is_hollow else colour,
        "linestyle": style.line,
        "markersize": _POINT if style.line == "none" and style.marker != "x" else _MARKER,
        # Hollow markers hide the line behind them.
        "zorder": 3,
    }
