"""Charts against distance: one per quantity, with panels for protocols, topologies and named steps.

A cell contains the repeats under one condition, and their estimates.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity, with_plain_name
from fieldkit.analysis.wording import scale_of
from fieldkit.core.columns import Kind, plain_name
from fieldkit.report import wording
from fieldkit.report.charts import Chart, EdgeMark, Panel, Series
from fieldkit.report.coverage import Absence, total_absences
from fieldkit.report.headlines import Ranking
from fieldkit.report.series import Identities, Identity, Point, axis_limits, panels, point
from fieldkit.report.trial_folders import Evidence

LOSS: Final = (
    "datagram_loss",
    "ip_loss",
    "tcp_byte_loss",
    "topic_loss",
    "iperf3_loss",
    "iperf3_captured_loss",
    "video_loss",
)
DELAY: Final = (
    "rtt_median_s",
    "one_way_median_s",
    "delay_s",
    "transfer_s",
    "topic_delay_median_s",
    "used_age_p95_s",
    "seen_age_p95_s",
)
RATE: Final = ("goodput_bit_s", "throughput_bit_s", "iperf3_throughput_bit_s")
"""Quantities with charts against distance by default, by section of the page."""

_DODGE: Final = 0.026
"""Offset between series at the same distance, as a share of the range of distances. It separates their intervals."""
_ASIDE: Final = 0.009
"""Offset of single repeats from the interval of their estimate, as a share of the range of distances."""
_MIN_JOINED: Final = 4
"""Smallest number of distances whose points are joined. A line through fewer points suggests an unmeasured curve."""
_MAX_WIDE: Final = 2
"""Maximum number of large panels of a chart of several steps. If the chart has more panels, all are drawn small."""
_MARGIN: Final = 0.06
"""Margin at each end of the axis beyond the outermost series, as a share of the range of distances."""
_TICKS_APART: Final = 0.16
"""Minimum distance between labels, as a share of the range of distances."""


def charts(
    cells: Sequence[Cell], identities: Identities, evidence: Evidence, names: Sequence[str]
) -> Iterator[Chart]:
    """Yield a chart for each of the quantities `names` that was measured, or should have been, at several distances.

    Named steps share a chart in which each step has its own panels. Round-trip times of different payload sizes must
    not be compared. If their step has no name, each size therefore has its own chart.
    """
    drawing = _CurveDrawing(cells, identities, evidence, Ranking(evidence))
    for name in names:
        matches = with_plain_name(evidence.quantities.values(), name)
        cells_by_step = {
            quantity: placed_cells
            for quantity in matches
            if quantity.step and (placed_cells := _cells_with_distance(cells, quantity))
        }
        for quantity in matches:
            for size, same_size in ({} if quantity.step else by_size(cells, quantity, evidence)).items():
                if placed_cells := _cells_with_distance(same_size, quantity):
                    yield from (chart.of_size(size) for chart in drawing.chart({quantity: placed_cells}))
        yield from drawing.chart(cells_by_step)


def is_curve(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> bool:
    """Return True if any panel has a quantity, or should have it, at more than one distance."""
    cells_without = (absence.cell for absence in total_absences(cells, quantity, evidence))
    distances_m: dict[tuple[str, str], set[float]] = {}
    for cell in (*_cells_with_distance(cells, quantity), *cells_without):
        distances_m.setdefault(wording.group(cell), set()).add(wording.metres(cell))
    return any(len(group_m) > 1 for group_m in distances_m.values())


def has_curve(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> bool:
    """Return True if a quantity of these cells has a curve, with pings of all sizes combined."""
    return is_curve(with_missing(cells, quantity, _cells_with_distance(cells, quantity)), quantity, evidence)


def by_size(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> Mapping[str, Sequence[Cell]]:
    """Return the cells that have a quantity: for a round-trip time by the pings' payload size, otherwise by ""."""
    measured_cells = [cell for cell in cells if quantity.name in cell.estimates]
    if plain_name(quantity.name) != "rtt_median_s":
        return {"": measured_cells} if measured_cells else {}
    return evidence.by_payload(measured_cells, quantity.step)


def with_missing(cells: Sequence[Cell], quantity: Quantity, group: Sequence[Cell]) -> list[Cell]:
    """Return the cells of a group, and the cells of the same protocols and topologies without the quantity."""
    groups = {wording.group(cell) for cell in group}
    return [
        cell
        for cell in cells
        if cell in group or (wording.group(cell) in groups and quantity.name not in cell.estimates)
    ]


def _cells_with_distance(cells: Sequence[Cell], quantity: Quantity) -> list[Cell]:
    """Return the cells that have a quantity and a distance."""
    return [cell for cell in cells if quantity.name in cell.estimates and cell.key["distance_m"] is not None]


@dataclass(frozen=True)
class _CurvePlace:
    """A condition in a panel.

    Attributes:
        cell: The condition.
        content: Its estimate, or the reason for the missing estimate.
        is_high: True if the cross for a missing estimate is at the upper end of the axis.
    """

    cell: Cell
    content: Point | Absence
    is_high: bool = True

    @property
    def metres(self) -> float:
        return wording.metres(self.cell)


@dataclass(frozen=True)
class _CurveDrawing:
    """Draws charts of the cells of one report."""

    cells: Sequence[Cell]
    identities: Identities
    evidence: Evidence
    ranking: Ranking

    def chart(self, cells_by_quantity: Mapping[Quantity, Sequence[Cell]]) -> Iterator[Chart]:
        """Yield the chart of a quantity, or of one quantity of several steps, if it has several distances."""
        if not any(
            is_curve(with_missing(self.cells, step_quantity, cells), step_quantity, self.evidence)
            for step_quantity, cells in cells_by_quantity.items()
        ):
            return
        quantity, has_steps = next(iter(cells_by_quantity)), len(cells_by_quantity) > 1
        values = [
            cell.estimates[step_quantity.name].value
            for step_quantity, cells in cells_by_quantity.items()
            for cell in cells
        ]
        scale = scale_of(quantity, values)
        groups = {
            _panel_title(title, step_quantity if has_steps else None, group, self.evidence): self._places(
                step_quantity, group, scale.factor
            )
            for step_quantity, cells in cells_by_quantity.items()
            for title, group in panels(cells).items()
        }
        label = quantity.label if quantity.step and not has_steps else _capital(quantity.plain_label)
        unit = "% of repeats" if quantity.kind is Kind.FLAG else scale.unit
        y_label = f"{label} [{unit}]" if unit else label
        points = [place.content for places in groups.values() for place in places if isinstance(place.content, Point)]
        limits_by_protocol = {
            protocol: axis_limits([point for point in points if point.protocol == protocol], scale.unit)
            for protocol in {point.protocol for point in points}
        }
        missing = [place for places in groups.values() for place in places if isinstance(place.content, Absence)]
        name = plain_name(quantity.name).removesuffix("_s").removesuffix("_bit").replace("_", "-")
        yield Chart(
            name=f"{name}-of-steps" if quantity.step else name,
            title=f"{label} against distance{', by step' if has_steps else ''}",
            caption=_caption(quantity, points, limits_by_protocol, has_missing=bool(missing)),
            panels=[
                self._panel(title, places, y_label, limits_by_protocol[wording.text(places[0].cell, "protocol")])
                for title, places in groups.items()
            ],
            is_dense=has_steps and len(groups) > _MAX_WIDE,
        )

    def _places(self, quantity: Quantity, group: Sequence[Cell], factor: float) -> list[_CurvePlace]:
        """Return the conditions of a panel in order of distance, including conditions without a value."""
        is_high = self.ranking.more_is_worse(quantity) is not False
        places = [_CurvePlace(cell, point(cell, quantity, factor, self.evidence)) for cell in group]
        places += [
            _CurvePlace(absence.cell, absence, is_high=is_high)
            for absence in total_absences(with_missing(self.cells, quantity, group), quantity, self.evidence)
            if absence.cell.key["distance_m"] is not None
        ]
        return sorted(places, key=lambda place: place.metres)

    def _panel(self, title: str, places: Sequence[_CurvePlace], y_label: str, limits: tuple[float, float]) -> Panel:
        places_by_label: dict[str, tuple[Identity, list[_CurvePlace]]] = {}
        for place in places:
            identity = self.identities.of(place.cell)
            places_by_label.setdefault(identity.label, (identity, []))[1].append(place)
        metres = [place.metres for place in places]
        span = (max(metres) - min(metres)) or 1.0
        middle = (len(places_by_label) - 1) / 2
        margin = (_MARGIN + middle * _DODGE) * span if len(set(metres)) > 1 else span / 2
        ranked_series = sorted(places_by_label.values(), key=lambda pair: pair[0].rank)
        shifts = [(rank - middle) * _DODGE * span for rank in range(len(ranked_series))]
        return Panel(
            title=title,
            x_label="distance",
            y_label=y_label,
            series=[
                _series(identity, series_places, shift, _ASIDE * span, limits)
                for shift, (identity, series_places) in zip(shifts, ranked_series, strict=True)
            ],
            description=_describe(title, y_label, places_by_label.values()),
            x_ticks=_ticks(places, span),
            bottom=limits[0],
            top=limits[1],
            left=min(metres) - margin,
            right=max(metres) + margin,
            edges=[
                EdgeMark(place.metres + shift, place.content.text, identity.style.colour, place.is_high)
                for shift, (identity, series_places) in zip(shifts, ranked_series, strict=True)
                for place in series_places
                if isinstance(place.content, Absence)
            ],
        )


def _capital(label: str) -> str:
    """Return a label with a capital letter, except for names of programs."""
    return label if label.startswith("iperf3") else label[:1].upper() + label[1:]


def _panel_title(title: str, quantity: Quantity | None, cells: Sequence[Cell], evidence: Evidence) -> str:
    """Return the title of a panel: with the step's name if there are several, and the payload size of its ping."""
    if quantity is None:
        return title
    sizes = evidence.payloads(cells, quantity.step) if plain_name(quantity.name) == "rtt_median_s" else []
    return ", ".join((quantity.step, title, *sizes))


_NO_LOSS_NOTE: Final = ", dotted if nothing was lost, because its width then depends only on the number of repeats"
_CUT_NOTE: Final = "an arrow if an interval continues beyond the axis; no repeat is drawn there"
_ABSENCE_NOTE: Final = "a cross at the edge, with the reason, if a condition has no value"
_COUNT_NOTE: Final = "next to a point, the number of valid repeats with a value, if not all have one"
_BOUND_NOTE: Final = "hollow, with an arrow: a lower bound, because the timed event had not ended"
_MEANINGS: Final = {
    "counted": "Share of all that was sent",
    "mean": "Mean over repeats",
    "median": "Median over repeats",
    "flag": "Share of the valid repeats in which it is true",
}


def _caption(
    quantity: Quantity,
    points: Sequence[Point],
    limits: Mapping[str, tuple[float, float]],
    *,
    has_missing: bool,
) -> str:
    has_no_loss = (
        quantity.unit == "share" and quantity.kind is not Kind.FLAG and any(point.value == 0 for point in points)
    )
    is_cut = any(point.top > limits[point.protocol][1] for point in points)
    parts = (
        f"{_MEANINGS[quantity.kind]}, with its 95 % interval{_NO_LOSS_NOTE if has_no_loss else ''}",
        "" if quantity.kind is Kind.FLAG else "faint: each repeat",
        _CUT_NOTE if is_cut else "",
        _ABSENCE_NOTE if has_missing else "",
        _COUNT_NOTE if any(point.note for point in points) else "",
        _BOUND_NOTE if any(any(point.bounds) for point in points) else "",
    )
    return f"{'; '.join(filter(None, parts))}."


def _series(
    identity: Identity, places: Sequence[_CurvePlace], shift: float, aside: float, limits: tuple[float, float]
) -> Series:
    points = [place.content for place in places if isinstance(place.content, Point)]
    is_line = len({point.metres for point in points}) >= _MIN_JOINED
    return Series(
        label=identity.label,
        style=identity.style,
        x=[point.metres + shift for point in points],
        y=[point.value for point in points],
        low=[point.low for point in points],
        high=[point.high for point in points],
        join="line" if is_line else "none",
        behind=[(point.metres + shift - aside, value) for point in points for value in point.singles(False)],
        behind_bounds=[(point.metres + shift - aside, value) for point in points for value in point.singles(True)],
        bounds=[point.is_bound for point in points],
        breaks=_breaks(places, limits) if is_line else (),
        notes=[point.note for point in points] if any(point.note for point in points) else (),
    )


def _breaks(places: Sequence[_CurvePlace], limits: tuple[float, float]) -> frozenset[int]:
    """Return the indexes of the points after which no line is drawn; -1 stands for the start, before the first point.

    A line does not start or end at a point with a vague interval, and does not cross a distance without a value.
    """
    breaks, index = set(), -1
    for place in places:
        if isinstance(place.content, Absence):
            breaks.add(index)
            continue
        index += 1
        if place.content.is_vague(limits):
            breaks |= {index - 1, index}
    return frozenset(breaks)


def _ticks(places: Sequence[_CurvePlace], span: float) -> list[tuple[float, str]]:
    """Return the distances that get a label, in metres, and the labels, as the operator wrote them."""
    labels: list[tuple[float, str]] = []
    for metres, label in sorted({(place.metres, wording.distance(place.cell)) for place in places}):
        if not labels or metres - labels[-1][0] >= _TICKS_APART * span:
            labels.append((metres, label))
    return labels


def _describe(title: str, y_label: str, series: Iterable[tuple[Identity, list[_CurvePlace]]]) -> str:
    """Return the description of a panel, with a list of values for each series."""
    sentences = [
        f"{identity.label or 'all'}: "
        + ", ".join(
            f"{f'{place.content.value:.2f}' if isinstance(place.content, Point) else place.content.text} "
            f"at {wording.distance(place.cell)}"
            for place in places
        )
        for identity, places in series
    ]
    return f"{y_label} against distance, {title}. " + "; ".join(sentences) + "."
