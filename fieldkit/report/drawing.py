"""Draw panels on axes of matplotlib; `figures` makes pages and files of them."""

import math
from collections.abc import Collection
from itertools import pairwise
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.lines import Line2D
from matplotlib.markers import CARETRIGHT, CARETUP
from matplotlib.ticker import FormatStrFormatter, MaxNLocator, NullFormatter

from fieldkit.core.text import harmless
from fieldkit.report.charts import EdgeMark, Panel, Series
from fieldkit.report.theme import LIGHT, Style

_MARKER: Final = 5.0
_POINT: Final = 3.0
"""Size of markers that stand in a crowd."""
_NOTE: Final = 6.5
"""Size of letters beside points."""
_FAINT: Final = 0.3
"""Opacity of single repeats behind what they come to."""
_STEPS: Final = (1, 2, 5, 10)
"""Of the ticks of an axis."""
_TITLE: Final = 48
_TICK: Final = 20
_LANE: Final = 26
_BOUND: Final = 4.0
"""Size of the triangles of single repeats that are lower bounds."""
_ARROW: Final = 14.0
"""Length of the arrow of a lower bound, in points."""
_STRIP_LANE: Final = 7.5
"""Size of letters of lanes whose room is fixed."""
_EDGE_TEXT: Final = 34
"""Letters for which there is room."""


def draw(axes: Axes, panel: Panel) -> None:
    """Draw a panel on axes."""
    axes.set_title(_fitting(panel.title, _TITLE))
    axes.set_xlabel(_fitting(panel.x_label, _TITLE))
    axes.set_ylabel(_fitting(panel.y_label, _TITLE))
    for series in panel.series:
        if len(series.x):  # matplotlib would make room for an empty one, at the corner of the figure
            _draw_series(axes, series, panel)
    for span in panel.spans:
        axes.barh(span.lane, span.stop - span.start, left=span.start, height=0.6, color=LIGHT[span.colour])
    _scale(axes, panel)
    for edge in panel.edges:
        _draw_edge(axes, edge, sideways=bool(panel.lanes))


def _scale(axes: Axes, panel: Panel) -> None:
    """Set the ends, the kind and the ticks of both axes."""
    if panel.log:
        axes.set_yscale("log")
    if panel.x_log:
        axes.set_xscale("log")
    if panel.lanes:
        axes.set_yticks(range(len(panel.lanes)), [_fitting(lane, _LANE) for lane in panel.lanes])
        if panel.is_strip:
            axes.tick_params(axis="y", labelsize=_STRIP_LANE)
        axes.set_ylim(-0.6, len(panel.lanes) - 0.4)
        axes.grid(visible=False, axis="y")
    else:
        axes.set_ylim(panel.bottom, panel.top)
        _number(axes.yaxis, is_log=panel.log, ticks=5)
    if panel.right is not None:
        axes.set_xlim(panel.left, panel.right)
    if panel.x_ticks:
        axes.set_xticks([at for at, _ in panel.x_ticks], [_fitting(label, _TICK) for _, label in panel.x_ticks])
        axes.grid(visible=False, axis="x")
    else:
        _number(axes.xaxis, is_log=panel.x_log, ticks=6)


def _number(axis: Axis, *, is_log: bool, ticks: int) -> None:
    """Let an axis have numbers, few enough to be read."""
    if not is_log:
        axis.set_major_locator(MaxNLocator(nbins=ticks, steps=_STEPS))
        return
    # Powers of ten are formulas otherwise, which text is no more.
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def _draw_series(axes: Axes, series: Series, panel: Panel) -> None:
    look = _look(series.style)
    if series.join == "steps":
        axes.step(series.x, series.y, where="post", **look)
        return
    is_sideways = bool(panel.lanes)
    _draw_singles(axes, series, panel)
    axes.plot(series.x, series.y, clip_on=False, **(look | {"linestyle": "none"}))
    if series.join == "line":
        for start, stop in _runs(len(series.x), series.breaks):
            axes.plot(series.x[start:stop], series.y[start:stop], clip_on=False, **(look | {"marker": None}))
    for x, y, low, high in zip(series.x, series.y, series.low, series.high, strict=False):
        if low is not None:
            ends = (low, math.inf if high is None else high)
            _draw_interval(axes, (y, x) if is_sideways else (x, y), ends, series.style, panel)
    for x, y, is_bound in zip(series.x, series.y, series.bounds, strict=False):
        if is_bound:
            _draw_bound(axes, (x, y), series.style, is_sideways=is_sideways)
    for x, y, note in zip(series.x, series.y, series.notes, strict=False):
        if note:
            text = axes.annotate(
                note, (x, y), (5, 5), textcoords="offset points", fontsize=_NOTE, color=LIGHT["lost"]
            )
            text.set_in_layout(False)


def _draw_singles(axes: Axes, series: Series, panel: Panel) -> None:
    """Draw single repeats faintly, those that are only lower bounds as triangles towards larger values."""
    is_sideways, top = bool(panel.lanes), _top(panel)
    colour = LIGHT[series.style.colour]
    for places, marker, size in (
        (series.behind, "o", _POINT),
        (series.behind_bounds, ">" if is_sideways else "^", _BOUND),
    ):
        shown = [place for place in places if place[0 if is_sideways else 1] <= top]
        faint: dict[str, Any] = {"color": colour, "alpha": _FAINT, "markersize": size, "markeredgewidth": 0}
        axes.plot([x for x, _ in shown], [y for _, y in shown], marker, **faint)


def _draw_bound(axes: Axes, at: tuple[float, float], style: Style, *, is_sideways: bool) -> None:
    """Draw a figure that is only a lower bound: a hollow marker, and an arrow towards larger values."""
    look = _look(style) | {"markerfacecolor": LIGHT["paper"], "linestyle": "none", "zorder": 4}
    axes.plot(*at, clip_on=False, **look)
    arrow = axes.annotate(
        "",
        at,
        (_ARROW, 0) if is_sideways else (0, _ARROW),
        textcoords="offset points",
        arrowprops={"arrowstyle": "<-", "color": look["color"], "linewidth": 1.1},
    )
    arrow.set_in_layout(False)


def _draw_interval(
    axes: Axes, at: tuple[float, float], interval: tuple[float, float], style: Style, panel: Panel
) -> None:
    """Draw the interval of a point at (place, value); an arrow where it continues beyond the end of the axis."""
    (place, value), (low, high), top = at, interval, _top(panel)
    if panel.x_log if panel.lanes else panel.log:
        low = max(low, panel.left if panel.lanes else panel.bottom or low)  # there is no 0 on such an axis
    colour, is_sideways = LIGHT[style.colour], bool(panel.lanes)
    # At nothing lost the interval only says how few repeats there are: it must not outshine what was seen.
    line: Any = "-" if value != 0 else (0, (1, 4))
    lines = axes.hlines if is_sideways else axes.vlines
    lines(place, low, min(high, top), color=colour, linewidth=1.1, linestyles=line)
    if high > top:
        end = (top, place) if is_sideways else (place, top)
        marker = CARETRIGHT if is_sideways else CARETUP
        axes.plot(*end, marker=marker, color=colour, markersize=_MARKER, clip_on=False)


def _top(panel: Panel) -> float:
    """Return the upper end of the axis of values."""
    end = panel.right if panel.lanes else panel.top
    return math.inf if end is None else end


def _runs(count: int, breaks: Collection[int]) -> list[tuple[int, int]]:
    """Return the stretches of points that a line joins, as (first, behind the last)."""
    ends = [-1, *sorted(index for index in breaks if 0 <= index < count - 1), count - 1]
    return [(before + 1, after + 1) for before, after in pairwise(ends) if after - before > 1]


def _draw_edge(axes: Axes, edge: EdgeMark, *, sideways: bool) -> None:
    """Draw a cross at the edge of the axis of values, and beside it why there is no value."""
    end = 1.0 if edge.is_high else 0.0
    at = (end, edge.at) if sideways else (edge.at, end)
    across = axes.get_yaxis_transform() if sideways else axes.get_xaxis_transform()
    axes.plot(*at, "x", color=LIGHT[edge.colour], markersize=_MARKER, clip_on=False, transform=across, zorder=4)
    inwards = -6 if edge.is_high else 6
    text = axes.annotate(
        _fitting(edge.text, _EDGE_TEXT),
        at,
        (inwards, 0) if sideways else (0, inwards),
        xycoords=across,
        textcoords="offset points",
        fontsize=_NOTE,
        color=LIGHT["lost"],
        rotation=0 if sideways else 90,
        ha=("right" if edge.is_high else "left") if sideways else "center",
        va="center" if sideways else ("top" if edge.is_high else "bottom"),
    )
    text.set_in_layout(False)  # it is inside the axes, which must not become smaller for it


def _fitting(text: str, most: int) -> str:
    said = harmless(text)
    return said if len(said) <= most else f"{said[: most - 1]}…"


def handle(label: str, style: Style) -> Line2D:
    """Return the sample of a series for a legend."""
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
