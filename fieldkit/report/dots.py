"""Dot plots of quantities that were measured at one distance: a lane per quantity, a panel per unit.

A cell contains the repeats under one condition, and their estimates.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.wording import Scale, measured, scale_of
from fieldkit.core.columns import Kind
from fieldkit.report import distance, wording
from fieldkit.report.charts import Chart, EdgeMark, Panel, Series
from fieldkit.report.coverage import total_absences
from fieldkit.report.headlines import Ranking
from fieldkit.report.series import Identities, Identity, Point, axis_limits, needs_log, panels, point
from fieldkit.report.trial_folders import Evidence

_DODGE: Final = 0.7
"""Share of a lane over which the conditions of one quantity are spread."""
_ASIDE: Final = 0.12
"""Offset of single repeats below their estimate, as a share of the height of a condition."""
_LOG_MARGIN: Final = 1.25
"""Factor between the ends of a logarithmic axis and the extreme values."""
_LABELS: Final = {
    "share": "share",
    "s": "time",
    "bit/s": "rate",
    "dBm": "signal",
    "m": "length",
    "m/s": "speed",
    "count": "count",
}
_EXPLANATION: Final = (
    "Each quantity with its 95 % interval: losses as shares of all that was sent, times and rates as medians over "
    "repeats. Faint points below it are single repeats. Properties that are true or false are shares of the valid "
    "repeats."
)


@dataclass(frozen=True)
class _Lane:
    """One quantity in one panel.

    Attributes:
        label: Its name, and the payload size of a ping.
        quantity: The quantity.
        cells: The conditions that have it.
        with_missing: These conditions, and those of the same protocol and topology that lack the quantity.
    """

    label: str
    quantity: Quantity
    cells: Sequence[Cell]
    with_missing: Sequence[Cell]


def charts(cells: Sequence[Cell], identities: Identities, evidence: Evidence) -> Iterator[Chart]:
    """Yield the dot plot of all quantities without a chart against distance, if there are any."""
    ranking = Ranking(evidence)
    quantities = measured(cells)
    first_quantities = ranking.first_quantities(quantities)
    ordered_quantities = [
        *first_quantities,
        *(quantity for quantity in quantities if quantity not in first_quantities),
    ]
    groups: dict[tuple[str, str, str], list[_Lane]] = {}
    for quantity in ordered_quantities:
        for size, same_size in distance.by_size(cells, quantity, evidence).items():
            all_cells = distance.with_missing(cells, quantity, same_size)
            if distance.is_curve(all_cells, quantity, evidence):
                continue
            for title, group in panels(same_size).items():
                label = ", ".join(filter(None, (quantity.label, size)))
                panel_cells = distance.with_missing(cells, quantity, group)
                place = wording.distance(group[0])
                groups.setdefault((title, place, quantity.unit), []).append(
                    _Lane(label, quantity, group, panel_cells)
                )
    if groups:
        drawing = _DotDrawing(identities, evidence, ranking)
        units = list(dict.fromkeys(unit for *_, unit in groups))
        places = list(dict.fromkeys(place for _, place, _ in groups))
        ranked_groups = sorted(groups.items(), key=lambda item: (units.index(item[0][2]), *item[0][:2]))
        drawn_panels = [
            drawing.panel(title if len(places) == 1 else f"{title}, {place}", unit, lanes)
            for (title, place, unit), lanes in ranked_groups
        ]
        yield Chart(
            "quantities", f"All quantities at {wording.join_words(places)}", _caption(drawn_panels), drawn_panels
        )


@dataclass(frozen=True)
class _DotDrawing:
    """Draws the panels of one report."""

    identities: Identities
    evidence: Evidence
    ranking: Ranking

    def panel(self, title: str, unit: str, lanes: Sequence[_Lane]) -> Panel:
        """Return the panel of the quantities of one unit."""
        values = [cell.estimates[lane.quantity.name].value for lane in lanes for cell in lane.cells]
        scale = scale_of(lanes[0].quantity, values)
        conditions = list({id(cell): cell for lane in lanes for cell in lane.with_missing}.values())
        conditions.sort(key=lambda cell: self.identities.of(cell).rank)
        step = _DODGE / len(conditions)
        offsets = {id(cell): _DODGE / 2 - (index + 0.5) * step for index, cell in enumerate(conditions)}
        points_by_label: dict[str, tuple[Identity, list[tuple[float, Point]]]] = {}
        edges: list[EdgeMark] = []
        for height, lane in enumerate(reversed(lanes)):
            for cell in lane.cells:
                identity = self.identities.of(cell)
                estimate = point(cell, lane.quantity, scale.factor, self.evidence)
                points_by_label.setdefault(identity.label, (identity, []))[1].append(
                    (height + offsets[id(cell)], estimate)
                )
            is_high = self.ranking.more_is_worse(lane.quantity) is not False
            edges += [
                EdgeMark(
                    height + offsets[id(absence.cell)],
                    absence.text,
                    self.identities.of(absence.cell).style.colour,
                    is_high,
                )
                for absence in total_absences(lane.with_missing, lane.quantity, self.evidence)
            ]
        points = [estimate for _, placed_points in points_by_label.values() for _, estimate in placed_points]
        ranked_series = sorted(points_by_label.values(), key=lambda pair: pair[0].rank)
        return _with_limits(
            Panel(
                title=title,
                x_label=_axis(unit, scale, lanes),
                y_label="",
                series=[_series(identity, placed_points, _ASIDE * step) for identity, placed_points in ranked_series],
                description=_describe(title, lanes, scale),
                lanes=[lane.label for lane in reversed(lanes)],
                edges=edges,
            ),
            points,
            scale.unit,
        )


def _axis(unit: str, scale: Scale, lanes: Sequence[_Lane]) -> str:
    if all(lane.quantity.kind is Kind.FLAG for lane in lanes):
        return "share of repeats [%]"
    label = _LABELS.get(unit, "value")
    return f"{label} [{scale.unit}]" if scale.unit else label


def _with_limits(panel: Panel, points: Sequence[Point], unit: str) -> Panel:
    """Return a panel with the ends of its axis of values, which is logarithmic if values need it."""
    values = list(chain.from_iterable((point.value, *point.repeats) for point in points))
    if needs_log(values):
        return replace(panel, x_log=True, left=min(values) / _LOG_MARGIN, right=max(values) * _LOG_MARGIN)
    left, right = axis_limits(points, unit)
    return replace(panel, left=left, right=right)


def _series(identity: Identity, placed_points: Sequence[tuple[float, Point]], aside: float) -> Series:
    points = [point for _, point in placed_points]
    return Series(
        label=identity.label,
        style=replace(identity.style, line="none"),
        x=[point.value for point in points],
        y=[height for height, _ in placed_points],
        low=[point.low for point in points],
        high=[point.high for point in points],
        join="none",
        behind=[(value, height - aside) for height, point in placed_points for value in point.singles(False)],
        behind_bounds=[(value, height - aside) for height, point in placed_points for value in point.singles(True)],
        bounds=[point.is_bound for point in points],
        notes=[point.note for point in points] if any(point.note for point in points) else (),
    )


def _caption(drawn_panels: Sequence[Panel]) -> str:
    parts = [
        _EXPLANATION,
        "The axis is logarithmic if values differ by a factor of more than about 30."
        if any(panel.x_log for panel in drawn_panels)
        else "",
        "Hollow, with an arrow: a lower bound, because the timed event had not ended."
        if any(series.behind_bounds for panel in drawn_panels for series in panel.series)
        else "",
        "A cross marks a condition without a value." if any(panel.edges for panel in drawn_panels) else "",
    ]
    return " ".join(filter(None, parts))


def _describe(title: str, lanes: Sequence[_Lane], scale: Scale) -> str:
    sentences = [
        f"{lane.label}: {', '.join(scale.amount(cell.estimates[lane.quantity.name].value) for cell in lane.cells)}"
        for lane in lanes
    ]
    return f"{title}. {'; '.join(sentences)}."
