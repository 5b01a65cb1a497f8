"""Charts as plain data. `figures` draws them for the page and for papers."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.report.theme import Colour, Style

Join = Literal["line", "steps", "none"]
"""Type of line between points. With `steps` a value applies until the next point, as in a distribution function."""


@dataclass(frozen=True, eq=False)
class Series:
    """Points that belong together.

    Attributes:
        label: Label in the legend; series with the same label have the same style.
        style: Colour, marker and line.
        x: Positions.
        y: Values.
        low: Lower ends of their intervals, None for a point without interval; empty if no point has one.
        high: Upper ends, in the same form as `low`.
        join: Type of line between the points.
        behind: Single values, as (x, y), which are drawn faintly behind the points.
        breaks: Indices of points after which the line is interrupted.
        notes: A short text next to each point, empty for a point without text; an empty sequence if no point has one.
        bounds: True for each value that is only a lower bound; empty if no value is one.
        behind_bounds: Like `behind`, for values that are only lower bounds.
    """

    label: str
    style: Style
    x: Sequence[float] | NDArray[np.float64]
    y: Sequence[float] | NDArray[np.float64]
    low: Sequence[float | None] = ()
    high: Sequence[float | None] = ()
    join: Join = "line"
    behind: Sequence[tuple[float, float]] = ()
    breaks: Collection[int] = ()
    notes: Sequence[str] = ()
    bounds: Sequence[bool] = ()
    behind_bounds: Sequence[tuple[float, float]] = ()


@dataclass(frozen=True)
class EdgeMark:
    """A cross at the edge of a panel for a condition without a value.

    Attributes:
        at: Its position on the axis of conditions: x, or the lane of a panel with lanes.
        text: The reason for the missing value.
        colour: Colour of the series without the value.
        is_high: True if it is at the upper end of the axis of values.
    """

    at: float
    text: str
    colour: Colour
    is_high: bool


@dataclass(frozen=True)
class Span:
    """A time interval in a lane.

    Attributes:
        lane: Number of the lane, from 0.
        start: Its start.
        stop: Its end.
        colour: Colour of the bar.
    """

    lane: int
    start: float
    stop: float
    colour: Colour


@dataclass(frozen=True)
class HeatMap:
    """A map of values over two factors.

    Attributes:
        columns: Labels of the columns, from the left.
        rows: Labels of the rows, from below.
        values: Values by row and column; nan if missing.
        texts: Texts of the values.
        limits: Values at the ends of the colour scale.
    """

    columns: Sequence[str]
    rows: Sequence[str]
    values: Sequence[Sequence[float]]
    texts: Sequence[Sequence[str]]
    limits: tuple[float, float]


@dataclass(frozen=True)
class Panel:
    """One set of axes.

    Attributes:
        title: Title above the axes.
        x_label: Quantity of the x axis, with its unit.
        y_label: Quantity of the y axis, with its unit.
        series: The series.
        description: Description for screen readers.
        x_ticks: Position and text of each tick; empty for automatic ticks.
        top: Upper end of the y axis, None for an automatic one.
        bottom: Lower end of the y axis, None for an automatic one.
        right: Right end of the x axis, None for automatic ends.
        left: Left end of the x axis, used if `right` is given.
        log: True for a logarithmic y axis; then `bottom` is above 0.
        x_log: True for a logarithmic x axis; then `left` is above 0.
        edges: Conditions without a value.
        is_strip: True for a wide, low panel with fixed margins, to be stacked on a shared x axis.
        spans: Bars in lanes.
        lanes: Names of the lanes, the lowest first; empty if y is a number. With lanes, values of series and their
            intervals are along x.
        heat: A heat map instead of series; None for other panels.
    """

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    description: str
    x_ticks: Sequence[tuple[float, str]] = ()
    top: float | None = None
    bottom: float | None = 0.0
    right: float | None = None
    left: float = 0.0
    log: bool = False
    x_log: bool = False
    edges: Sequence[EdgeMark] = ()
    is_strip: bool = False
    spans: Sequence[Span] = ()
    lanes: Sequence[str] = ()
    heat: HeatMap | None = None


@dataclass(frozen=True)
class Chart:
    """A figure: panels side by side or, if `is_stacked`, below each other, under one legend.

    Attributes:
        name: Name in file names and links.
        title: Title of the figure.
        caption: Explanation, and a note about omitted data.
        panels: At least one.
        is_dense: True if panels are simple enough to be drawn small.
        is_stacked: True if panels are below each other.
    """

    name: str
    title: str
    caption: str
    panels: Sequence[Panel]
    is_dense: bool = False
    is_stacked: bool = False

    def of_size(self, size: str) -> "Chart":
        """Return the chart with a packet size in its name and title, or unchanged if `size` is empty."""
        if not size:
            return self
        return replace(self, name=f"{self.name}-{size.replace(' ', '-')}", title=f"{self.title}, {size}")

    @property
    def legend(self) -> dict[str, Style]:
        """The style of each label that has points, in the order of drawing; empty for a single label."""
        styles = {series.label: series.style for panel in self.panels for series in panel.series if len(series.x)}
        return styles if len(styles) > 1 else {}
