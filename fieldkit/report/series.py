"""Series of figures: panels of conditions, the style of each series in all figures, and estimates as points.

A cell contains the repeats under one condition, and their estimates.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Final

import numpy as np

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.wording import incomplete
from fieldkit.core.columns import Kind
from fieldkit.core.model import Scenario
from fieldkit.report import wording
from fieldkit.report.theme import CYCLE, LINES, Style
from fieldkit.report.trial_folders import Evidence

_SCENARIOS = [str(scenario) for scenario in Scenario]


@dataclass(frozen=True)
class Identity:
    """Label and style of a series.

    Attributes:
        label: `LOS`, with the procedure if several procedures share a scenario, and the backend if there are several.
        style: Its style.
        rank: Sort key: by scenario and procedure, then by backend, the field backend first.
    """

    label: str
    style: Style
    rank: tuple[int, int]


class Identities:
    """The identity of the series that each cell belongs to: procedure and scenario by colour, backend by line.

    Args:
        cells: All cells of the report, so that each has the same style in every figure.
    """

    def __init__(self, cells: Sequence[Cell]) -> None:
        kinds = sorted({_kind(cell) for cell in cells}, key=_by_scenario)
        backends = sorted({wording.text(cell, "backend") for cell in cells}, key=lambda name: (name != "field", name))
        # The first series with line of sight and the first without have fixed styles, even if the other is missing.
        fixed_ranks, next_ranks = (
            {str(scenario): rank for rank, scenario in enumerate(Scenario)},
            count(len(Scenario)),
        )
        self._kinds = {
            kind: fixed_ranks.pop(kind[0]) if kind[0] in fixed_ranks else next(next_ranks) for kind in kinds
        }
        self._backends = {name: index for index, name in enumerate(backends)}
        self._has_shared_scenario = len({scenario for scenario, _ in kinds}) < len(kinds)

    def of(self, cell: Cell) -> Identity:
        """Return the identity of the series of `cell`."""
        backend = wording.text(cell, "backend")
        parts = (
            wording.scenario(cell),
            wording.procedure(cell) if self._has_shared_scenario else "",
            backend if len(self._backends) > 1 else "",
        )
        rank = self._kinds[_kind(cell)], self._backends[backend]
        style = Style(*CYCLE[rank[0] % len(CYCLE)], LINES[rank[1] % len(LINES)])
        return Identity(", ".join(filter(None, parts)), style, rank)


def panels(cells: Sequence[Cell]) -> Mapping[str, Sequence[Cell]]:
    """Return cells by the title of their panel, one per protocol and topology: `UDP, master`."""
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((wording.text(cell, "protocol"), wording.text(cell, "topology")), []).append(cell)
    return {
        ", ".join(filter(None, (protocol.upper(), topology))) or "all": group
        for (protocol, topology), group in sorted(groups.items())
    }


def _kind(cell: Cell) -> tuple[str, str]:
    """Return scenario and procedure of a cell, which determine the colour of its series."""
    return wording.text(cell, "scenario"), wording.text(cell, "procedure")


def _by_scenario(kind: tuple[str, str]) -> tuple[bool, int, str, str]:
    """Return the sort key of a scenario and procedure; procedures that are named after their scenario come first."""
    scenario, procedure = kind
    index = _SCENARIOS.index(scenario) if scenario in _SCENARIOS else len(_SCENARIOS)
    return scenario != procedure, index, scenario, procedure


MAX_BEHIND: Final = 100
"""Maximum number of single repeats that are drawn behind one estimate. If there are more, every k-th is drawn."""
_MIN_BEHIND: Final = 10
"""Smallest value of `max_behind`, which applies if there are many conditions."""
_MAX_BEHIND_IN_CHART: Final = 2000
"""Maximum number of single repeats in the chart of a quantity, divided equally among the conditions of the table."""
_MIN_TOP_PERCENT: Final = 1.0
"""Smallest upper end of an axis of percentages."""
_TOP_FACTOR: Final = 1.08
"""Ratio between the upper end of an axis that starts at 0 and the largest value."""
_MAX_AXIS_FACTOR: Final = 2.0
"""Maximum end of an axis that starts at 0, as a multiple of the largest estimate, before `_TOP_FACTOR` is applied.
Intervals are cut at the end of the axis, and repeats beyond it are not drawn."""
_MARGIN_SHARE: Final = 0.25
"""Margins of an axis that does not start at 0, as a share of the range of values."""
_LOG_FROM_DECADES: Final = 1.5
"""Range of values, in decades, above which an axis is logarithmic."""
_MAX_INTERVAL_SHARE: Final = 0.5
"""Width of an interval as a share of the axis. A point with a wider interval is too uncertain for a curve."""


@dataclass(frozen=True)
class Point:
    """One estimate in the unit of the axis.

    Attributes:
        cell: The condition.
        value: The estimate.
        low: Lower end of its 95 % interval; None if it has none.
        high: Upper end; None if there is no interval, or if it is open because of lower bounds.
        repeats: Values of single repeats; if there are many, only some of them.
        bounds: True for each value in `repeats` that is only a lower bound.
        is_bound: True if the estimate is only a lower bound because of such values.
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
        """Return the values of single repeats: those that are only lower bounds if `are_bounds`, else the others."""
        return [value for value, is_bound in zip(self.repeats, self.bounds, strict=True) if is_bound is are_bounds]

    def is_vague(self, ends: tuple[float, float]) -> bool:
        """Return True if the point is a lower bound, or its interval is missing, open or wider than half of the axis.

        `ends` are the ends of the axis.
        """
        if self.low is None or self.high is None or self.is_bound:
            return True
        return self.high - self.low > _MAX_INTERVAL_SHARE * (ends[1] - ends[0])


def max_behind(evidence: Evidence) -> int:
    """Return the maximum number of single repeats that are drawn behind one estimate."""
    return min(MAX_BEHIND, max(_MIN_BEHIND, _MAX_BEHIND_IN_CHART // max(1, evidence.n_conditions)))


def point(cell: Cell, quantity: Quantity, factor: float, evidence: Evidence) -> Point:
    """Return the estimate of a quantity under one condition, with values multiplied by `factor`.

    The point of a flag contains no single repeats, because their values could only be 0 or 1.
    """
    estimate = cell.estimates[quantity.name]
    low, high = (None if end is None else factor * end for end in (estimate.low, estimate.high))
    values, is_bound = evidence.observed(cell, quantity)
    every_kth = slice(None, None, max(math.ceil(len(values) / max_behind(evidence)), 1))
    if quantity.kind is Kind.FLAG:
        values, is_bound = values[:0], is_bound[:0]
    return Point(
        cell,
        factor * estimate.value,
        low,
        high,
        repeats=tuple((factor * values[every_kth]).tolist()),
        bounds=tuple(is_bound[every_kth].tolist()),
        is_bound=estimate.is_lower_bound,
        note=incomplete(estimate),
    )


def axis_limits(points: Sequence[Point], unit: str) -> tuple[float, float]:
    """Return the ends of an axis for these points. It starts at 0 unless a value is negative, as in dBm."""
    if min(point.bottom for point in points) < 0:
        values = [value for point in points for value in (point.value, *point.repeats)]
        low, high = min(values), max(values)
        margin = _MARGIN_SHARE * (high - low) or 1.0
        return low - margin, high + margin
    largest_value, highest_top = max(point.value for point in points), max(point.top for point in points)
    top = min(highest_top, _MAX_AXIS_FACTOR * largest_value) if largest_value > 0 else highest_top
    return 0.0, max(_TOP_FACTOR * top, _MIN_TOP_PERCENT if unit == "%" else 0.0) or 1.0


def needs_log(values: Iterable[float]) -> bool:
    """Return True if values need a logarithmic axis: all above 0, over more than 1.5 decades."""
    finite = np.fromiter(values, np.float64)
    finite = finite[np.isfinite(finite)]
    if not len(finite) or finite.min() <= 0:
        return False
    return bool(np.log10(finite.max() / finite.min()) > _LOG_FROM_DECADES)
