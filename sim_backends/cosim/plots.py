"""Draws figures of co-simulations for publications. No other module of `sim_backends` imports matplotlib.

The figures have the same style as the figures of trials (`fieldkit.report.theme`). Their bytes are the same on every
machine.
"""

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from fieldkit.core.text import sanitized
from fieldkit.report.theme import CYCLE, LIGHT, METADATA, SETTINGS, Colour, Format, Marker
from sim_backends.cosim.plot_layout import (
    FlowTrace,
    LabelBox,
    LogPanel,
    ObstacleOutline,
    Point,
    curve_boxes,
    direction_arrow,
    place_labels,
    stack_labels,
)

_FONT_POINTS: Final = 8.0
"""Font size of labels of figures in IEEE's template for papers."""
_BOTH_COLUMNS_INCHES: Final = 7.16
"""Width of a figure: both columns of an IEEE paper."""
_PANEL_HEIGHT_INCHES: Final = 2.9
_LABEL_POINTS: Final = 7.0
"""Font size of the labels of curves."""
_RUN_HEIGHT_INCHES: Final = 3.2
"""Height of the figure of a run."""
_TIME_AXIS_FACTOR: Final = 1.45
"""Ratio of the length of the time axis to the duration of the run; the difference is the space for labels."""
_MARKER_POINTS: Final = 5.0
_POINTS_PER_INCH: Final = 72.0
_ZERO_SHARE: Final = 0.16
"""Distance of the line for zeros below the lowest power of ten, as a share of the length of the logarithmic axis."""
_LEADER_POINTS: Final = 5.0
"""Minimum distance of a label from its point at which a line connects them."""
_BACKGROUND: Final = {"facecolor": LIGHT["paper"], "edgecolor": "none", "pad": 0.3}
_TEXT_BRIGHTNESS: Final = 0.75
"""Ratio of the brightness of a label to the brightness of its curve."""
_LETTER_WIDTH: Final = 0.58
"""Mean width of a letter of DejaVu Sans, relative to the font size."""

_STYLES: Final[Mapping[str, tuple[Colour, Marker]]] = {
    "event_driven": ("ink", "o"),
    "variable_stepped": ("muted", "s"),
    "time_stepped": ("blue", "o"),
    "scheduled": ("sky", "s"),
    "sliding_window": ("green", "^"),
    "velocity_aware_raw": ("pink", "D"),
    "velocity_aware": ("red", "v"),
    "error_bounded": ("orange", "P"),
}
"""Colour and marker of each sync policy, the same in all figures; other curves have the styles in `CYCLE`."""


def log_figure(panels: Sequence[LogPanel], form: Format) -> bytes:
    """Return a figure of panels side by side, two per row, as wide as both columns of a paper.

    Args:
        panels: At least one.
        form: File format.
    """
    columns = min(2, len(panels))
    rows = math.ceil(len(panels) / columns)
    with _drawing():
        figure = Figure(figsize=(_BOTH_COLUMNS_INCHES, _PANEL_HEIGHT_INCHES * rows), layout="constrained")
        drawn_panels = []
        for number, panel in enumerate(panels, start=1):
            axes = figure.add_subplot(rows, columns, number)
            drawn_panels.append((axes, panel, _draw_log(axes, panel)))
        figure.draw_without_rendering()  # the axes have their final positions only after this call
        figure.set_layout_engine("none")
        for axes, panel, curves in drawn_panels:
            _label(
                axes,
                [curve.label or curve.name for curve in panel.curves],
                curves,
                at_right=panel.labels_at_right or panel.over_time,
            )
        return _saved(figure, form)


def run_figure(
    title: str,
    paths_m: Mapping[str, Sequence[tuple[float, float]]],
    flows: Sequence[FlowTrace],
    form: Format,
    outlines: Sequence[ObstacleOutline] = (),
) -> bytes:
    """Return a figure of a run, as wide as both columns of a paper: paths from above, delay and distance over time.

    Args:
        title: Title above the figure.
        paths_m: Positions of each agent over time, metres east and north, at least one each.
        flows: The flows of the run.
        form: File format.
        outlines: Obstacles around the agents.
    """
    with _drawing():
        figure = Figure(figsize=(_BOTH_COLUMNS_INCHES, _RUN_HEIGHT_INCHES), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.25))
        map_axes = figure.add_subplot(grid[:, 0])
        map_axes.set_title(sanitized(title))
        _draw_paths(map_axes, paths_m)
        for outline in outlines:
            # Added as an artist without data, so that distant obstacles do not change the limits of the axes.
            shade, alpha = LIGHT["muted"], 0.2 if outline.is_passable else 0.6
            map_axes.add_artist(Polygon(outline.corners_m, facecolor=shade, alpha=alpha, linewidth=0, zorder=1))
        delay, distance = (figure.add_subplot(grid[row, 1]) for row in (0, 1))
        _draw_delays(delay, flows)
        distance.set(xlabel="sent at (s)", ylabel="distance (m)")
        curves = []
        for number, flow in enumerate(flows):
            curves += distance.plot(flow.sent_s, flow.distance_m, color=_colour(number), zorder=3)
        distance.set_ylim(bottom=0)
        end_s = max((max(flow.sent_s) for flow in flows), default=1.0)
        for axes in (delay, distance):
            _set_time_axis(axes, end_s)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        _label(distance, [flow.name for flow in flows], curves, at_right=True)
        lines = map_axes.get_lines()
        _label(map_axes, list(paths_m), lines[len(paths_m) :], other_lines=lines[: len(paths_m)])
        return _saved(figure, form)


def _set_time_axis(axes: Axes, end_s: float) -> None:
    """Set the x axis to times from 0 to an end, and leave space for labels at the right."""
    axes.set_xlim(0, end_s * _TIME_AXIS_FACTOR)
    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, steps=(1, 2, 5, 10)))
    axes.set_xticks([tick for tick in axes.get_xticks() if 0 <= tick <= end_s * 1.02])


def _draw_delays(axes: Axes, flows: Sequence[FlowTrace]) -> None:
    """Draw the delay of each packet; packets that never arrived are marked at the top, in one row per flow."""
    axes.set(ylabel="delay (ms)", yscale="log")
    for number, flow in enumerate(flows):
        delay_ms = 1e3 * np.asarray(flow.delay_s, np.float64)
        axes.plot(flow.sent_s, delay_ms, ".", color=_colour(number), markersize=2, zorder=3)
        lost_s = np.asarray(flow.sent_s, np.float64)[np.isnan(delay_ms)]
        height = 1.0 + 0.06 * (len(flows) - number)
        style: dict[str, Any] = {"color": _colour(number), "markersize": 4, "clip_on": False}
        if len(lost_s):  # for an empty series, matplotlib would leave space at the corner of the figure
            axes.plot(lost_s, [height] * len(lost_s), "|", transform=axes.get_xaxis_transform(), **style)
    axes.yaxis.set_major_formatter(FuncFormatter(_plain))
    axes.yaxis.set_minor_formatter(NullFormatter())
    if any(math.isnan(delay_s) for flow in flows for delay_s in flow.delay_s):
        axes.text(
            1.0, 1.03, "| lost", transform=axes.transAxes, ha="right", fontsize=_LABEL_POINTS, color=LIGHT["muted"]
        )


def interval_figure(panels: Mapping[str, Mapping[str, tuple[float, float, float]]], form: Format) -> bytes:
    """Return a figure of values with their intervals: a panel per quantity, a row per name, and a line at 0.

    Args:
        panels: For each quantity with its unit: value, lower and upper end of the interval, by name.
        form: File format.
    """
    with _drawing():
        figure = Figure(figsize=(_BOTH_COLUMNS_INCHES, _PANEL_HEIGHT_INCHES), layout="constrained")
        first: Axes | None = None
        for number, (label, values) in enumerate(panels.items(), start=1):
            axes = figure.add_subplot(1, len(panels), number, sharey=first)
            axes.set(xlabel=f"bias of {label}")
            axes.axvline(0, color=LIGHT["muted"], linewidth=0.8)
            for row, (name, (value, low, high)) in enumerate(values.items()):
                colour, marker = _style(name, row)
                axes.hlines(row, low, high, color=LIGHT[colour], zorder=3)
                axes.plot(value, row, marker=marker, color=LIGHT[colour], markersize=_MARKER_POINTS, zorder=3)
            axes.set_yticks(range(len(values)), list(values))
            axes.tick_params(axis="y", labelleft=first is None)
            axes.xaxis.set_major_locator(MaxNLocator(nbins=4))
            first = first or axes
        if first is not None:
            first.invert_yaxis()
        return _saved(figure, form)


def _draw_paths(axes: Axes, paths_m: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Draw the path of each agent from above, with a marker at its start and an arrow at its end."""
    axes.set(aspect="equal", xlabel="east (m)", ylabel="north (m)")
    # Paths are grey and their ends black, because colours distinguish flows.
    for path_m in paths_m.values():
        axes.plot(*zip(*path_m, strict=True), color=LIGHT["muted"], zorder=3)
    for number, path_m in enumerate(paths_m.values()):
        marker = CYCLE[number % len(CYCLE)][1]
        axes.plot(*path_m[0], marker=marker, color=LIGHT["ink"], markersize=_MARKER_POINTS, zorder=3)
        if (arrow_ends := direction_arrow(path_m)) is not None:
            arrow = {"arrowstyle": "-|>", "color": LIGHT["ink"], "linewidth": 0.6, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", arrow_ends[1], arrow_ends[0], arrowprops=arrow, zorder=3)
    axes.margins(0.15)
    axes.set_adjustable("datalim")


def _draw_log(axes: Axes, panel: LogPanel) -> list[Line2D]:
    """Draw the curves, and return their lines."""
    axes.set_xscale("linear" if panel.over_time else "log")
    axes.set_yscale("log")
    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    axes.set_title(panel.title)
    positive = [value for curve in panel.curves for value in curve.y if value > 0]
    low, high = (min(positive), max(positive)) if positive else (0.1, 1.0)
    # Whole decades; the factor keeps a marker at a power of ten below the upper end.
    low, high = 10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(high * 1.001))
    has_zero = any(value == 0 for curve in panel.curves for value in curve.y)
    zero = low / 10 ** (_ZERO_SHARE * max(math.log10(high / low), 1))
    drawn_lines: list[Line2D] = []
    for number, curve in enumerate(panel.curves):
        colour, marker = _style(curve.name, number)
        shown_marker = "" if panel.over_time else marker
        style: dict[str, Any] = {"color": LIGHT[colour], "marker": shown_marker, "markersize": _MARKER_POINTS}
        drawn_lines += axes.plot(curve.x, [max(y, zero) for y in curve.y], clip_on=False, zorder=3, **style)
    _set_ticks(axes, panel, zero if has_zero else None, low, high)
    return drawn_lines


def _set_ticks(axes: Axes, panel: LogPanel, zero: float | None, low: float, high: float) -> None:
    """Set the limits and the ticks of both axes.

    Args:
        axes: The axes.
        panel: The curves.
        zero: Position of the line for zeros on the y axis; None if no value is 0.
        low: Lower end of the logarithmic y axis.
        high: Upper end of the logarithmic y axis.
    """
    xs = [value for curve in panel.curves for value in curve.x if value > 0]
    first, last = min(xs, default=0.5), max(xs, default=1.0)
    if panel.over_time:
        _set_time_axis(axes, last)
    else:
        # If labels are at the right, the logarithmic axis is about twice as long as the curves.
        axes.set_xlim(first / 2, last * 2 * (last / first if panel.labels_at_right else 1))
        axes.set_xticks([tick for tick in axes.get_xticks() if first / 2 <= tick <= last * 2])
    # On the logarithmic axis, the zeros are between its lower end and a dotted line, which separates them from `low`.
    axes.set_ylim(zero / (low / zero) ** 0.7 if zero is not None else low, high)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(_plain))
        axis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()
    if zero is not None:
        decades = range(round(math.log10(low)), round(math.log10(high)) + 1)
        ticks = [10.0**power for power in decades]
        axes.set_yticks([zero, *ticks], ["0", *map(_plain, ticks)])
        axes.axhline(low / (low / zero) ** 0.5, color=LIGHT["muted"], linewidth=0.6, linestyle=(0, (1, 3)))


def _label(
    axes: Axes,
    labels: Sequence[str],
    drawn_lines: Sequence[Line2D],
    *,
    at_right: bool = False,
    other_lines: Sequence[Line2D] = (),
) -> None:
    """Write the label of each line next to it; lines that coincide share one label.

    Args:
        axes: The axes of the lines, at their final position.
        labels: One per line.
        drawn_lines: The lines.
        at_right: True to stack the labels at the right.
        other_lines: Further lines that labels must not cover.
    """
    groups: dict[tuple[Point, ...], list[int]] = {}
    for index, line in enumerate(drawn_lines):
        groups.setdefault(_points(axes, line), []).append(index)
    texts = [sanitized("\n".join(labels[index] for index in group)) for group in groups.values()]
    sizes = [_text_size(text) for text in texts]
    scale = _POINTS_PER_INCH / axes.figure.dpi
    window = axes.get_window_extent()
    bounds = LabelBox(window.x0 * scale, window.y0 * scale, window.width * scale, window.height * scale)
    if at_right:
        last = [points[-1] for points in groups]
        left = bounds.left + bounds.width - max((width for width, _ in sizes), default=0.0)
        places = list(zip(last, stack_labels(last, sizes, left, bounds), strict=True))
    else:
        covered = [*groups, *(_points(axes, line) for line in other_lines)]
        places = place_labels(list(groups), sizes, bounds, list(curve_boxes(covered, _MARKER_POINTS / 2 + 1)))
    for (point, box), text, group in zip(places, texts, groups.values(), strict=True):
        _annotate(axes, text, point, box, str(drawn_lines[group[0]].get_color()), at_left=at_right)


def _points(axes: Axes, line: Line2D) -> tuple[Point, ...]:
    """Return the points of a line in the figure, rounded to whole points (1/72 inch), without repetitions."""
    data = np.asarray(line.get_xydata(), np.float64)
    xy = np.rint(axes.transData.transform(data) * _POINTS_PER_INCH / axes.figure.dpi)
    return tuple(point for point, _ in groupby((float(x), float(y)) for x, y in xy))


def _text_size(text: str) -> tuple[float, float]:
    """Return the width and height of a label, in points (1/72 inch)."""
    lines = text.split("\n")
    return _LETTER_WIDTH * _LABEL_POINTS * max(map(len, lines)), 1.25 * _LABEL_POINTS * len(lines)


def _annotate(axes: Axes, text: str, point: Point, box: LabelBox, colour: str, *, at_left: bool) -> None:
    """Write a label into a box; if the box is far from its point, draw a line to it.

    Args:
        axes: The axes.
        text: The label.
        point: The point that the label belongs to.
        box: The box of the label.
        colour: Colour of the curve.
        at_left: True if the line begins at the left side of the label.
    """
    line = {"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 0, "shrinkB": _MARKER_POINTS / 2}
    end = {"relpos": (0.0, 0.5)} if at_left else {}
    axes.annotate(
        text,
        point,
        (box.left, box.bottom + box.height / 2),
        xycoords="figure points",
        textcoords="figure points",
        fontsize=_LABEL_POINTS,
        color=_darker(colour),
        ha="left",
        va="center",
        annotation_clip=False,
        zorder=4,
        bbox=_BACKGROUND,
        arrowprops={**line, **end} if box.gap(point) > _LEADER_POINTS else None,
    )


def _colour(number: int) -> str:
    return LIGHT[CYCLE[number % len(CYCLE)][0]]


def _plain(value: float, _: object = None) -> str:
    """Return the label of a tick: the number, with an exponent only below 0.0001 or from 10,000,000."""
    return f"{value:,.7g}"


def _style(name: str, number: int) -> tuple[Colour, Marker]:
    return _STYLES.get(name.partition(" ")[0]) or CYCLE[number % len(CYCLE)]


def _darker(colour: str) -> str:
    """Return a darker colour, in which text is readable on white."""
    red, green, blue = (int(int(colour[at : at + 2], 16) * _TEXT_BRIGHTNESS) for at in (1, 3, 5))
    return f"#{red:02x}{green:02x}{blue:02x}"


@contextmanager
def _drawing() -> Iterator[None]:
    """Apply the style of the figures during the body of the `with` statement."""
    sizes = dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize"), _FONT_POINTS)
    settings: dict[Any, Any] = {**SETTINGS, **sizes}
    with mpl.rc_context():
        # The user's matplotlibrc must not change the figure.
        mpl.rcdefaults()
        mpl.rcParams.update(settings)
        yield


def _saved(figure: Figure, form: Format) -> bytes:
    """Return a figure as the content of a file."""
    out = io.BytesIO()
    figure.savefig(out, format=form, metadata=METADATA[form])
    return out.getvalue()
