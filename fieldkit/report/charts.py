"""Charts as plain data: `figures` draws them, for the page and for papers."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fieldkit.report.theme import Colour, Style

Join = Literal["line", "steps", "none"]
"""How points are joined: `steps` as a distribution function, which keeps its value up to the next point."""


@dataclass(frozen=True, eq=False)
class Series:
    """Points that belong together.

    Attributes:
        label: For the legend; series of one label have one style.
        style: How it looks.
        x: Positions.
        y: Values.
        low: Lower ends of their intervals, None where there is none; empty when no point has one.
        high: Upper ends.
        join: How the points are joined.
        behind: What the points stand for, as (x, y): drawn faintly behind them.
        breaks: Points, by index, after which the line is interrupted.
        notes: A short text beside each point, empty for none; empty when no point has one.
        bounds: Whether each value is only a lower bound; empty when none is.
        behind_bounds: Like `behind`, for what is only a lower bound.
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
    """A cross at the edge of a panel where a condition has no value.

    Attributes:
        at: Its place along the axis of conditions: x, or the lane of a panel with lanes.
        text: Why there is no value.
        colour: Of the series that lacks it.
        is_high: Whether it is at the upper end of the axis of values.
    """

    at: float
    text: str
    colour: Colour
    is_high: bool


@dataclass(frozen=True)
class Span:
    """A stretch of time in a lane.

    Attributes:
        lane: Number of the lane, from 0.
        start: Where it begins.
        stop: Where it ends.
        colour: Of the bar.
    """

    lane: int
    start: float
    stop: float
    colour: Colour


@dataclass(frozen=True)
class Panel:
    """One set of axes.

    Attributes:
        title: Above it.
        x_label: What x is, with its unit.
        y_label: What y is, with its unit.
        series: What is drawn.
        words: What it shows, for those who cannot see it.
        x_ticks: Position and text of each tick; empty leaves them to the drawing.
        top: Upper end of the y axis, None to leave it to the drawing.
        bottom: Lower end of the y axis, likewise.
        right: Right end of the x axis, likewise.
        left: Left end of the x axis, where `right` is given.
        log: Whether the y axis is logarithmic; then `bottom` is above 0.
        x_log: Whether the x axis is logarithmic; then `left` is above 0.
        edges: Conditions without a value.
        is_strip: Whether it is wide and low, with the same margins as others, to be stacked on a shared x axis.
        spans: Bars in lanes.
        lanes: Names of the lanes, the lowest first; none when y is a number. With lanes, values of series and their
            intervals are along x.
    """

    title: str
    x_label: str
    y_label: str
    series: Sequence[Series]
    words: str
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


@dataclass(frozen=True)
class Chart:
    """A figure: panels side by side, under one legend.

    Attributes:
        name: For file names and links.
        title: What it is.
        caption: How to read it, and what was left out.
        panels: At least one.
        is_dense: Whether panels are many and plain enough to stand small.
        is_stacked: Whether panels stand below each other.
    """

    name: str
    title: str
    caption: str
    panels: Sequence[Panel]
    is_dense: bool = False
    is_stacked: bool = False

    def of_size(self, size: str) -> "Chart":
        """Return the chart, said to be of packets of this size; none is said where `size` is empty."""
        if not size:
            return self
        return replace(self, name=f"{self.name}-{size.replace(' ', '-')}", title=f"{self.title}, {size}")

    @property
    def legend(self) -> dict[str, Style]:
        """The style of each label that has points, in the order of drawing; empty when one label needs no legend."""
        found = {series.label: series.style for panel in self.panels for series in panel.series if len(series.x)}
        return found if len(found) > 1 else {}
