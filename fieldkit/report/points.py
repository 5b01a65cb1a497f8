"""Estimates as points of a figure: value, interval, single repeats, and the limits of the axis."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.wording import incomplete
from fieldkit.core.columns import Kind
from fieldkit.report import wording
from fieldkit.report.trial_folders import Evidence

MOST_BEHIND: Final = 100
"""Most single repeats behind one estimate; of more repeats, every k-th is drawn."""
_LEAST_TOP_PERCENT: Final = 1.0
_MOST_LENGTH: Final = 2.0
"""Most length of the axis, as a multiple of the largest value. Wider intervals are cut there."""
_MARGIN: Final = 0.25
"""Margins of an axis that does not start at 0, as a share of the range of values."""
_LOG_FROM_DECADES: Final = 1.5
_VAGUE_FROM: Final = 0.5
"""Width from which an interval is too wide for a curve, as a share of the axis."""


@dataclass(frozen=True)
class Point:
    """One estimate in the unit of the axis.

    Attributes:
        cell: The condition.
        value: The figure.
        low: Lower end of its 95 % interval, None without one.
        high: Upper end, None without one.
        repeats: Values of single repeats, some of them if there are many.
        bounds: True for each of these that is only a lower bound.
        is_bound: True if the figure is only a lower bound because of them.
        note: Number of valid repeats with a value, if not all have one: `2 of 3`.
    """

    cell: Cell
    value: float
    low: float | None
    high: float | None
    repeats: tuple[float, ...]
    bounds: tuple[bool, ...] = ()
    is_bound: bool = False
    note: str = ""

    @property
    def protocol(self) -> str:
        """The protocol of the condition."""
        return wording.text(self.cell, "protocol")

    @property
    def metres(self) -> float:
        """The distance of the condition."""
        return wording.metres(self.cell)

    @property
    def top(self) -> float:
        """The largest of value, interval and repeats."""
        return max(self.value, *self.repeats, *([] if self.high is None else [self.high]))

    @property
    def bottom(self) -> float:
        """The smallest of value, interval and repeats."""
        return min(self.value, *self.repeats, *([] if self.low is None else [self.low]))

    def singles(self, are_bounds: bool) -> list[float]:
        """Return the values of single repeats that are only lower bounds, or of those that are not."""
        return [value for value, is_bound in zip(self.repeats, self.bounds, strict=True) if is_bound is are_bounds]

    def is_vague(self, ends: tuple[float, float]) -> bool:
        """Return True if the point has no interval, an open one, or one as wide as half of the axis."""
        if self.low is None or self.high is None or self.is_bound:
            return True
        return self.high - self.low > _VAGUE_FROM * (ends[1] - ends[0])


def point(cell: Cell, quantity: Quantity, factor: float, evidence: Evidence) -> Point:
    """Return the estimate of a quantity under one condition, with values multiplied by `factor`.

    A flag has no single repeats, since each is either 0 or 1.
    """
    estimate = cell.estimates[quantity.name]
    low, high = (None if end is None else factor * end for end in (estimate.low, estimate.high))
    values, is_bound = evidence.observed(cell, quantity)
    every_kth = slice(None, None, max(-(-len(values) // MOST_BEHIND), 1))
    if quantity.kind is Kind.FLAG:
        values = values[:0]
    return Point(
        cell,
        factor * estimate.value,
        low,
        high,
        repeats=tuple((factor * values[every_kth]).tolist()),
        bounds=tuple(is_bound[every_kth].tolist())[: len(values)],
        is_bound=estimate.is_lower_bound,
        note=incomplete(estimate),
    )


def ends(points: Sequence[Point], unit: str) -> tuple[float, float]:
    """Return the ends of an axis for these points. It starts at 0 unless a value is negative, as in dBm."""
    if min(each.bottom for each in points) < 0:
        values = [value for each in points for value in (each.value, *each.repeats)]
        low, high = min(values), max(values)
        margin = _MARGIN * (high - low) or 1.0
        return low - margin, high + margin
    largest, highest = max(each.value for each in points), max(each.top for each in points)
    top = min(highest, _MOST_LENGTH * largest) if largest > 0 else highest
    return 0.0, max(1.08 * top, _LEAST_TOP_PERCENT if unit == "%" else 0.0) or 1.0


def needs_log(values: Iterable[float]) -> bool:
    """Return True if values need a logarithmic axis: all above 0, over more than 1.5 decades."""
    finite = np.fromiter(values, np.float64)
    finite = finite[np.isfinite(finite)]
    if not len(finite) or finite.min() <= 0:
        return False
    return bool(np.log10(finite.max() / finite.min()) > _LOG_FROM_DECADES)
