"""Figures of matplotlib for the page and for papers. Equal inputs give equal bytes with the same matplotlib."""

import io
import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Final, Literal

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from typing_extensions import override

from fieldkit.core import files
from fieldkit.core.text import sanitized
from fieldkit.lab.protocol import Overview
from fieldkit.report import drawing
from fieldkit.report.charts import Chart, Panel
from fieldkit.report.theme import FORMATS, LIGHT, METADATA, SETTINGS, Colour, Format

_MARKER_SIZE: Final = 5.0
_PANEL_INCHES: Final = (4.4, 2.75)
_STRIP_INCHES: Final = (5.8, 1.25)
"""Size of a strip without lanes."""
_STRIP_MARGINS_INCHES: Final = (1.45, 0.15, 0.42, 0.28)
"""Left, right, lower and upper margin of a strip, the same for all so that their x axes are aligned."""
_LANE_INCHES: Final = 0.3
_HEAT_ROW_INCHES: Final = 0.16
_LANE_MARGINS_INCHES: Final = 1.05
"""Heights of a lane, of a row of a heat map, and of both margins of a panel with lanes or rows."""
# Figures of IEEE papers are one column, 3.5 in, or both columns, 7.16 in, wide.
_COLUMN_INCHES: Final = 3.5
_BOTH_COLUMNS_INCHES: Final = 7.16
_PAPER_PANEL_INCHES: Final = 2.3
_PAPER_LEGEND_INCHES: Final = 0.3
"""Heights of a panel and of the legend in a figure for a paper."""

_MATERIAL_COLOURS: Final[dict[str, Colour]] = {
    "foliage": "green",
    "wood": "orange",
    "brick": "red",
    "ground": "orange",
}
"""Colours of obstacles that are not grey."""
_SNR_RANGE_DB: Final = (0.0, 60.0)
"""Range of the colour scale, the same in all figures: from almost no reception to more than any data rate needs."""
_LABEL_BACKGROUND: Final = {"facecolor": LIGHT["paper"], "edgecolor": "none", "pad": 0.5}
_EDGE_SHARE: Final = 0.15
"""Width of the zone at each edge in which labels are aligned inwards, as a share of the world."""

_MAX_LABELLED_LINKS: Final = 15
"""Maximum number of links that are labelled with their SNR: the number of pairs of six robots."""
_MIN_LABELLED_SHARE: Final = 0.1
"""Minimum length of a labelled link, as a share of the longer side of the world."""


class _Figure(Figure):
    """A figure that is drawn only once when it is saved.

    For a constrained layout, `savefig` calls `draw` twice: first with a layout engine and a renderer without output,
    then without a layout engine to draw the output. Here the first call only computes the layout. It does not need
    to draw the figure for that, which would take a quarter of the time.
    """

    @override
    def draw(self, renderer: RendererBase) -> None:
        engine = self.get_layout_engine()
        if isinstance(engine, ConstrainedLayoutEngine):
            engine.execute(self)
        else:
            super().draw(renderer)


def panel_svg(panel: Panel) -> str:
    """Return one panel as an SVG document for the page.

    The background is transparent, texts remain texts, and the colours are those of the light theme.
    """
    with _settings(9.0):
        width, height = _inches(panel)
        figure = _Figure(figsize=(width, height), layout=None if panel.is_strip else "constrained")
        drawing.draw(figure.add_subplot(), panel)
        if panel.is_strip:
            left, right, below, above = _STRIP_MARGINS_INCHES
            figure.subplots_adjust(
                left=left / width, right=1 - right / width, bottom=below / height, top=1 - above / height
            )
        return _to_bytes(figure, "svg", transparent=True).decode()


def _inches(panel: Panel) -> tuple[float, float]:
    """Return width and height of a panel of the page."""
    lanes = _LANE_MARGINS_INCHES + _LANE_INCHES * len(panel.lanes)
    if panel.heat is not None:
        return _PANEL_INCHES[0], max(_PANEL_INCHES[1], _LANE_MARGINS_INCHES + _HEAT_ROW_INCHES * len(panel.heat.rows))
    if panel.is_strip:
        return _STRIP_INCHES[0], lanes if panel.lanes else _STRIP_INCHES[1]
    return _PANEL_INCHES[0], lanes if panel.lanes else _PANEL_INCHES[1]


def paper(chart: Chart, file_format: Format) -> bytes:
    """Return the file of a chart with its legend: one column of a paper wide, or both if it has several panels."""
    columns = 1 if chart.is_stacked else min(2, len(chart.panels))
    rows = math.ceil(len(chart.panels) / columns)
    width = _COLUMN_INCHES if len(chart.panels) == 1 else _BOTH_COLUMNS_INCHES
    height = _STRIP_INCHES[1] if chart.is_stacked else _PAPER_PANEL_INCHES
    with _settings(8.0):
        figure = _Figure(figsize=(width, height * rows + _PAPER_LEGEND_INCHES), layout="constrained")
        for number, panel in enumerate(chart.panels, start=1):
            drawing.draw(figure.add_subplot(rows, columns, number), panel)
        if chart.legend:
            handles = [drawing.handle(label, style) for label, style in chart.legend.items()]
            figure.legend(handles=handles, loc="outside upper center", ncols=min(4, len(handles)))
        return _to_bytes(figure, file_format, transparent=False)


def save(charts: Iterable[Chart], folder: Path) -> Iterator[Path]:
    """Write charts as `paper` draws them in every format, and yield the paths.

    Args:
        charts: The charts.
        folder: An existing folder.

    Raises:
        OSError: A file cannot be written.
    """
    for chart in charts:
        for file_format in FORMATS:
            path = folder / f"{chart.name}.{file_format}"
            files.write(path, paper(chart, file_format))
            yield path


def overview(lab: Overview, file_format: Format) -> bytes:
    """Return the file of a plan view of a lab: obstacles, robots, links coloured by SNR (dotted: no reception)."""
    with _settings(8.0):
        figure = _Figure(figsize=(_BOTH_COLUMNS_INCHES, _BOTH_COLUMNS_INCHES * 0.75), layout="constrained")
        axes = figure.add_subplot()
        axes.set_title(sanitized(f"{lab.world}, {len(lab.robots)} robots"), wrap=True)
        axes.set(
            xlim=(0, lab.area_m[0]), ylim=(0, lab.area_m[1]), aspect="equal", xlabel="east (m)", ylabel="north (m)"
        )
        for outline in lab.outlines:
            axes.fill(
                *zip(*outline.corners, strict=True),
                color=LIGHT[_MATERIAL_COLOURS.get(outline.material, "muted")],
                alpha=0.45,
            )
        if lab.links:
            _draw_links(figure, axes, lab)
        east_m, north_m = zip(*lab.robots.values(), strict=True)
        axes.plot(east_m, north_m, "o", color=LIGHT["ink"], markersize=_MARKER_SIZE, zorder=4, clip_on=False)
        for name, place_m in lab.robots.items():
            # Most links are in the middle of the drawing, so labels are on the outer side of their robots, unless
            # they would then be outside of the world.
            share = place_m[1] / lab.area_m[1]
            is_above = share < _EDGE_SHARE or (place_m[1] >= fmean(north_m) and share <= 1 - _EDGE_SHARE)
            axes.annotate(
                sanitized(name),
                place_m,
                (0, 4 if is_above else -4),
                textcoords="offset points",
                fontsize=5,
                ha=_side(place_m[0], lab.area_m[0]),
                va="bottom" if is_above else "top",
                zorder=5,
            )
        return _to_bytes(figure, file_format, transparent=False)


def _side(east_m: float, width_m: float) -> Literal["left", "center", "right"]:
    """Return the alignment of a label, so that it stays inside of the world."""
    share = east_m / width_m
    return "left" if share < _EDGE_SHARE else "right" if share > 1 - _EDGE_SHARE else "center"


def _draw_links(figure: Figure, axes: Axes, lab: Overview) -> None:
    lines = [[lab.robots[end] for end in link.ends] for link in lab.links]
    line_collection = LineCollection(
        lines,
        array=[link.snr_db for link in lab.links],
        cmap="viridis",
        linestyles=["solid" if link.linked else "dotted" for link in lab.links],
        linewidths=1.2 if len(lines) <= _MAX_LABELLED_LINKS else 0.4,
        zorder=2,
    )
    line_collection.set_clim(*_SNR_RANGE_DB)
    axes.add_collection(line_collection)
    figure.colorbar(line_collection, ax=axes, label="SNR (dB)", shrink=0.7)
    for (place_m, other_m), link in zip(lines, lab.links, strict=True):
        if len(lines) <= _MAX_LABELLED_LINKS and math.dist(place_m, other_m) > _MIN_LABELLED_SHARE * max(lab.area_m):
            middle_m = (place_m[0] + other_m[0]) / 2, (place_m[1] + other_m[1]) / 2
            axes.annotate(
                sanitized(", ".join((f"{link.snr_db:.0f} dB", *link.through))),
                middle_m,
                fontsize=5,
                ha=_side(middle_m[0], lab.area_m[0]),
                va="center",
                zorder=3,
                bbox=_LABEL_BACKGROUND,
            )


@contextmanager
def _settings(points: float) -> Iterator[None]:
    """Use fieldkit's settings of matplotlib in the body, with a font size in points."""
    with mpl.rc_context(), warnings.catch_warnings():
        # A user's matplotlibrc must not change the output.
        mpl.rcdefaults()
        mpl.rcParams.update(SETTINGS | {"font.size": points, "axes.titlesize": points, "axes.labelsize": points})
        # A character that the font DejaVu lacks is correct text in SVG. In the other formats it is a box, which is
        # better than a warning without a remedy.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def _to_bytes(figure: Figure, file_format: Format, *, transparent: bool) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format=file_format, metadata=METADATA[file_format], transparent=transparent)
    return out.getvalue()
