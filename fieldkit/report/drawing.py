"""Draw panels on axes of matplotlib. The module `figures` creates the figures that contain the axes."""

import math
import textwrap
from collections.abc import Collection
from itertools import pairwise
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.lines import Line2D
from matplotlib.markers import CARETRIGHT, CARETUP
from matplotlib.ticker import FormatStrFormatter, MaxNLocator, NullFormatter

from fieldkit.core.text import sanitized
from fieldkit.report.charts import EdgeMark, HeatMap, Panel, Series
from fieldkit.report.theme import LIGHT, Style

_MARKER_SIZE: Final = 5.0
_SMALL_MARKER_SIZE: Final = 3.0
"""Sizes of normal and of small markers."""
_NOTE_FONT_SIZE: Final = 6.5
"""Font size of texts next to points."""
_FAINT_OPACITY: Final = 0.3
"""Opacity of single repeats behind their estimate."""
_TICK_STEPS: Final = (1, 2, 5, 10)
"""Multiples of a power of ten for the distance of ticks."""
_MAX_TITLE_LENGTH: Final = 48
_MAX_TICK_LENGTH: Final = 20
_MAX_LANE_LENGTH: Final = 26
"""Maximum numbers of characters of titles and axis labels, of tick labels, and of each line of a lane's name."""
_BOUND_MARKER_SIZE: Final = 4.0
"""Size of the triangles of single repeats whose values are only lower bounds."""
_ARROW_POINTS: Final = 14.0
"""Length of the arrow of a lower bound, in points."""
_STRIP_LANE_FONT_SIZE: Final = 7.5
"""Font size of lane names in panels of a fixed height."""
_LIGHT_TEXT_FROM: Final = 0.6
"""Position on the colour scale of a heat map, 0 to 1, from which texts are light."""
_TEXT_ON_LIGHT: Final = "#111111"
_TEXT_ON_DARK: Final = "#fefefe"
"""Colours of texts in a heat map, on light and on dark colours. They are the same in both themes, because the colours
of a heat map are."""
_MAX_LEVEL_CHARACTERS: Final = 40
"""Labels below a heat map are vertical if their number times the length of the longest exceeds this value."""
_FULL_SIZE_COLUMNS: Final = 12
"""The texts of a heat map are smaller if it has more than this number of columns."""
_MIN_FONT_SIZE: Final = 3.5
"""Smallest font size of texts in a heat map."""
_MAX_EDGE_TEXT_LENGTH: Final = 34
"""Maximum number of characters of the reason next to an `EdgeMark`."""


def draw(axes: Axes, panel: Panel) -> None:
    """Draw a panel on axes."""
    axes.set_title(_shorten(panel.title, _MAX_TITLE_LENGTH))
    axes.set_xlabel(_shorten(panel.x_label, _MAX_TITLE_LENGTH))
    axes.set_ylabel(_shorten(panel.y_label, _MAX_TITLE_LENGTH))
    if panel.heat is not None:
        _draw_heat(axes, panel.heat)
        return
    for series in panel.series:
        if len(series.x):  # matplotlib reserves space for an empty series
            _draw_series(axes, series, panel)
    for span in panel.spans:
        axes.barh(span.lane, span.stop - span.start, left=span.start, height=0.6, color=LIGHT[span.colour])
    _set_axes(axes, panel)
    for edge in panel.edges:
        _draw_edge(axes, edge, sideways=bool(panel.lanes))


def _draw_heat(axes: Axes, heat: HeatMap) -> None:
    """Draw a heat map with the text of each value, dark on light colours."""
    low, high = heat.limits
    axes.pcolormesh(heat.values, cmap="Blues", vmin=low, vmax=high, edgecolors=LIGHT["paper"], linewidth=1.0)
    columns = len(heat.columns)
    font_size = (
        _NOTE_FONT_SIZE
        if columns <= _FULL_SIZE_COLUMNS
        else max(_NOTE_FONT_SIZE * _FULL_SIZE_COLUMNS / columns, _MIN_FONT_SIZE)
    )
    for row, texts in enumerate(heat.texts):
        for column, text in enumerate(texts):
            is_dark = heat.values[row][column] > low + _LIGHT_TEXT_FROM * (high - low)
            colour = _TEXT_ON_DARK if is_dark else _TEXT_ON_LIGHT
            axes.text(column + 0.5, row + 0.5, text, color=colour, ha="center", va="center", fontsize=font_size)
    labels = [_shorten(label, _MAX_TICK_LENGTH) for label in heat.columns]
    axes.set_xticks([index + 0.5 for index in range(len(labels))], labels)
    if len(labels) * max(map(len, labels)) > _MAX_LEVEL_CHARACTERS:
        axes.tick_params(axis="x", rotation=90)
    axes.set_yticks(
        [index + 0.5 for index in range(len(heat.rows))], [_shorten(y, _MAX_LANE_LENGTH) for y in heat.rows]
    )
    axes.grid(visible=False)


def _set_axes(axes: Axes, panel: Panel) -> None:
    """Set the limits, the scale and the ticks of both axes."""
    if panel.log:
        axes.set_yscale("log")
    if panel.x_log:
        axes.set_xscale("log")
    if panel.lanes:
        axes.set_yticks(range(len(panel.lanes)), [_wrap(lane, _MAX_LANE_LENGTH) for lane in panel.lanes])
        if panel.is_strip:
            axes.tick_params(axis="y", labelsize=_STRIP_LANE_FONT_SIZE)
        axes.set_ylim(-0.6, len(panel.lanes) - 0.4)
        axes.grid(visible=False, axis="y")
    else:
        axes.set_ylim(panel.bottom, panel.top)
        _set_ticks(axes.yaxis, is_log=panel.log, ticks=5)
    if panel.right is not None:
        axes.set_xlim(panel.left, panel.right)
    if panel.x_ticks:
        axes.set_xticks(
            [at for at, _ in panel.x_ticks], [_shorten(label, _MAX_TICK_LENGTH) for _, label in panel.x_ticks]
        )
        axes.grid(visible=False, axis="x")
    else:
        _set_ticks(axes.xaxis, is_log=panel.x_log, ticks=6)


def _set_ticks(axis: Axis, *, is_log: bool, ticks: int) -> None:
    """Set a small number of ticks with plain numbers."""
    if not is_log:
        axis.set_major_locator(MaxNLocator(nbins=ticks, steps=_TICK_STEPS))
        return
    # The default formatter writes powers of ten as formulas, which are not plain text in SVG.
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def _draw_series(axes: Axes, series: Series, panel: Panel) -> None:
    options = _line_options(series.style)
    if series.join == "steps":
        axes.step(series.x, series.y, where="post", **options)
        return
    is_sideways = bool(panel.lanes)
    _draw_singles(axes, series, panel)
    axes.plot(series.x, series.y, clip_on=False, **(options | {"linestyle": "none"}))
    if series.join == "line":
        for start, stop in _line_segments(len(series.x), series.breaks):
            axes.plot(series.x[start:stop], series.y[start:stop], clip_on=False, **(options | {"marker": None}))
    for x, y, low, high in zip(series.x, series.y, series.low, series.high, strict=False):
        if low is not None:
            interval = (low, math.inf if high is None else high)
            _draw_interval(axes, (y, x) if is_sideways else (x, y), interval, series.style, panel)
    for x, y, is_bound in zip(series.x, series.y, series.bounds, strict=False):
        if is_bound:
            _draw_bound(axes, (x, y), series.style, is_sideways=is_sideways)
    for x, y, note in zip(series.x, series.y, series.notes, strict=False):
        if note:
            text = axes.annotate(
                note, (x, y), (5, 5), textcoords="offset points", fontsize=_NOTE_FONT_SIZE, color=LIGHT["lost"]
            )
            text.set_in_layout(False)


def _draw_singles(axes: Axes, series: Series, panel: Panel) -> None:
    """Draw single repeats faintly, lower bounds as triangles that point to larger values."""
    is_sideways, top = bool(panel.lanes), _value_limit(panel)
    colour = LIGHT[series.style.colour]
    for points, marker, size in (
        (series.behind, "o", _SMALL_MARKER_SIZE),
        (series.behind_bounds, ">" if is_sideways else "^", _BOUND_MARKER_SIZE),
    ):
        visible_points = [point for point in points if point[0 if is_sideways else 1] <= top]
        faint: dict[str, Any] = {"color": colour, "alpha": _FAINT_OPACITY, "markersize": size, "markeredgewidth": 0}
        axes.plot([x for x, _ in visible_points], [y for _, y in visible_points], marker, **faint)


def _draw_bound(axes: Axes, at: tuple[float, float], style: Style, *, is_sideways: bool) -> None:
    """Draw a value that is only a lower bound: a hollow marker, and an arrow towards larger values."""
    options = _line_options(style) | {"markerfacecolor": LIGHT["paper"], "linestyle": "none", "zorder": 4}
    axes.plot(*at, clip_on=False, **options)
    arrow = axes.annotate(
        "",
        at,
        (_ARROW_POINTS, 0) if is_sideways else (0, _ARROW_POINTS),
        textcoords="offset points",
        arrowprops={"arrowstyle": "<-", "color": options["color"], "linewidth": 1.1},
    )
    arrow.set_in_layout(False)


def _draw_interval(
    axes: Axes, at: tuple[float, float], interval: tuple[float, float], style: Style, panel: Panel
) -> None:
    """Draw the interval of a point at (position, value), with an arrow if it continues beyond the end of the axis."""
    (position, value), (low, high), top = at, interval, _value_limit(panel)
    if panel.x_log if panel.lanes else panel.log:
        low = max(low, panel.left if panel.lanes else panel.bottom or low)  # a logarithmic axis has no 0
    colour, is_sideways = LIGHT[style.colour], bool(panel.lanes)
    # If the value is 0, for example because nothing was lost, the width of the interval depends only on the number of
    # repeats, so it is drawn as a dotted line.
    line: Any = "-" if value != 0 else (0, (1, 4))
    lines = axes.hlines if is_sideways else axes.vlines
    lines(position, low, min(high, top), color=colour, linewidth=1.1, linestyles=line)
    if high > top:
        end = (top, position) if is_sideways else (position, top)
        marker = CARETRIGHT if is_sideways else CARETUP
        axes.plot(*end, marker=marker, color=colour, markersize=_MARKER_SIZE, clip_on=False)


def _value_limit(panel: Panel) -> float:
    """Return the upper end of the axis of values."""
    end = panel.right if panel.lanes else panel.top
    return math.inf if end is None else end


def _line_segments(count: int, breaks: Collection[int]) -> list[tuple[int, int]]:
    """Return the ranges of points that a line joins, as (first, last + 1)."""
    ends = [-1, *sorted(index for index in breaks if 0 <= index < count - 1), count - 1]
    return [(before + 1, after + 1) for before, after in pairwise(ends) if after - before > 1]


def _draw_edge(axes: Axes, edge: EdgeMark, *, sideways: bool) -> None:
    """Draw a cross at the edge of the axis of values, with the reason for the missing value."""
    end = 1.0 if edge.is_high else 0.0
    at = (end, edge.at) if sideways else (edge.at, end)
    transform = axes.get_yaxis_transform() if sideways else axes.get_xaxis_transform()
    axes.plot(
        *at, "x", color=LIGHT[edge.colour], markersize=_MARKER_SIZE, clip_on=False, transform=transform, zorder=4
    )
    inwards = -6 if edge.is_high else 6
    text = axes.annotate(
        _shorten(edge.text, _MAX_EDGE_TEXT_LENGTH),
        at,
        (inwards, 0) if sideways else (0, inwards),
        xycoords=transform,
        textcoords="offset points",
        fontsize=_NOTE_FONT_SIZE,
        color=LIGHT["lost"],
        rotation=0 if sideways else 90,
        ha=("right" if edge.is_high else "left") if sideways else "center",
        va="center" if sideways else ("top" if edge.is_high else "bottom"),
    )
    text.set_in_layout(False)  # the text is inside of the axes, so they must not shrink for it


def _wrap(text: str, max_length: int) -> str:
    """Return a text, which may contain any characters, sanitized and wrapped into at most two lines."""
    return "\n".join(textwrap.wrap(sanitized(text), max_length, max_lines=2, placeholder="…", break_on_hyphens=False))


def _shorten(text: str, max_length: int) -> str:
    clean = sanitized(text)
    return clean if len(clean) <= max_length else f"{clean[: max_length - 1]}…"


def handle(label: str, style: Style) -> Line2D:
    """Return the legend handle of a series."""
    return Line2D([], [], label=_shorten(label, _MAX_TITLE_LENGTH), **_line_options(style))


def _line_options(style: Style) -> dict[str, Any]:
    colour = LIGHT[style.colour]
    return {
        "color": colour,
        "marker": style.marker or None,
        "markerfacecolor": LIGHT["paper"] if style.is_hollow else colour,
        "linestyle": style.line,
        "markersize": _SMALL_MARKER_SIZE if style.line == "none" and style.marker != "x" else _MARKER_SIZE,
        # Above lines, whose zorder is 2 in matplotlib, so that a hollow marker hides the line behind it.
        "zorder": 3,
    }
