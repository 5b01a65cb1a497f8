"""Charts against distance: a chart per quantity; protocols, topologies and steps that have a name in panels."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity, alike
from fieldkit.analysis.wording import scale_of
from fieldkit.core.columns import Kind, plain_name
from fieldkit.report import wording
from fieldkit.report.charts import Chart, EdgeMark, Panel, Series
from fieldkit.report.conditions import Identities, Identity, panels
from fieldkit.report.coverage import Absence, absences
from fieldkit.report.evidence import Evidence
from fieldkit.report.points import Point, ends, point
from fieldkit.report.ranking import Ranking

LOSS: Final = ("datagram_loss", "ip_loss", "tcp_byte_loss", "topic_loss", "iperf3_loss", "iperf3_captured_loss")
DELAY: Final = ("rtt_median_s", "one_way_median_s", "delay_s", "transfer_s", "topic_delay_median_s")
RATE: Final = ("goodput_bit_s", "throughput_bit_s", "iperf3_throughput_bit_s")

_DODGE: Final = 0.026
"""Between series at the same distance, as a share of the axis, so that no interval hides another."""
_ASIDE: Final = 0.009
"""Of single repeats, from the interval of their estimate, likewise."""
_FEWEST_JOINED: Final = 4
"""Distances from which on their points are joined: a line through fewer suggests a course that nobody measured."""
_MOST_WIDE: Final = 2
"""Panels of a chart of several steps that stand large."""
_MARGIN: Final = 0.06
"""At either end of the axis, likewise."""
_TICKS_APART: Final = 0.16
"""Of the axis, so that no label of a distance runs into another."""


def charts(
    cells: Sequence[Cell], identities: Identities, evidence: Evidence, names: Sequence[str]
) -> Iterator[Chart]:
    """Yield a chart for each of the quantities `names` that was measured at several distances.

    Those of steps that have a name share one, a panel for each step. Round trips of requests of different sizes have
    charts of their own, unless the names of their steps tell them apart: beside each other they would be compared.
    """
    drawing = _CurveDrawing(cells, identities, evidence, Ranking(evidence))
    for name in names:
        found = alike(evidence.quantities.values(), name)
        of_steps = {one: measured for one in found if one.step and (measured := _placed(cells, one))}
        for quantity in found:
            for size, same in ({} if quantity.step else by_size(cells, quantity, evidence)).items():
                if placed := _placed(same, quantity):
                    yield from (chart.of_size(size) for chart in drawing.chart({quantity: placed}))
        yield from drawing.chart(of_steps)


def is_curve(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> bool:
    """Return whether any panel has a quantity, or should have it, at more than one distance."""
    lacking = (absence.cell for absence in absences(cells, quantity, evidence) if absence.is_total)
    metres: dict[tuple[str, str], set[float]] = {}
    for cell in (*_placed(cells, quantity), *lacking):
        metres.setdefault(_group(cell), set()).add(wording.metres(cell))
    return any(len(places) > 1 for places in metres.values())


def has_curve(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> bool:
    """Return whether a quantity of these cells has a curve, pings of all sizes taken together."""
    return is_curve(around(cells, quantity, _placed(cells, quantity)), quantity, evidence)


def by_size(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> Mapping[str, Sequence[Cell]]:
    """Return the cells that have a quantity by the size of their pings, if it is their round-trip time; else all."""
    having = [cell for cell in cells if quantity.name in cell.estimates]
    if plain_name(quantity.name) != "rtt_median_s":
        return {"": having} if having else {}
    return evidence.by_payload(having, quantity.step)


def around(cells: Sequence[Cell], quantity: Quantity, group: Sequence[Cell]) -> list[Cell]:
    """Return the cells of a group, and those of its protocols and topologies that do not have the quantity."""
    alike_ = {_group(cell) for cell in group}
    return [
        cell for cell in cells if cell in group or (_group(cell) in alike_ and quantity.name not in cell.estimates)
    ]


def _placed(cells: Sequence[Cell], quantity: Quantity) -> list[Cell]:
    """Return the cells that have a quantity and a distance."""
    return [cell for cell in cells if quantity.name in cell.estimates and cell.key["distance_m"] is not None]


@dataclass(frozen=True)
class _CurvePlace:
    """A condition in a panel: an estimate, or why there is none."""

    cell: Cell
    found: Point | Absence
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

    def chart(self, measured: Mapping[Quantity, Sequence[Cell]]) -> Iterator[Chart]:
        """Yield the chart of a quantity, or of the same one of several steps, if several distances have it."""
        if not any(is_curve(around(self.cells, one, cells), one, self.evidence) for one, cells in measured.items()):
            return
        quantity, several = next(iter(measured)), len(measured) > 1
        values = [cell.estimates[one.name].value for one, cells in measured.items() for cell in cells]
        written = scale_of(quantity, values)
        groups = {
            _titled(title, one if several else None, group, self.evidence): self._places(one, group, written.factor)
            for one, cells in measured.items()
            for title, group in panels(cells).items()
        }
        label = quantity.label if quantity.step and not several else _capital(quantity.plain_label)
        unit = "% of repeats" if quantity.kind is Kind.FLAG else written.unit
        y_label = f"{label} [{unit}]" if unit else label
        every = [place.found for places in groups.values() for place in places if isinstance(place.found, Point)]
        of_protocols = {
            protocol: ends([point for point in every if point.protocol == protocol], written.unit)
            for protocol in {point.protocol for point in every}
        }
        lacking = [place for places in groups.values() for place in places if isinstance(place.found, Absence)]
        name = plain_name(quantity.name).removesuffix("_s").removesuffix("_bit").replace("_", "-")
        yield Chart(
            name=f"{name}-of-steps" if quantity.step else name,
            title=f"{label} against distance{', by step' if several else ''}",
            caption=_caption(quantity, every, of_protocols, is_lacking=bool(lacking)),
            panels=[
                self._panel(title, places, y_label, of_protocols[wording.text(places[0].cell, "protocol")])
                for title, places in groups.items()
            ],
            is_dense=several and len(groups) > _MOST_WIDE,
        )

    def _places(self, quantity: Quantity, group: Sequence[Cell], factor: float) -> list[_CurvePlace]:
        """Return the conditions of a panel in the order of distance, those without a value too."""
        is_up = self.ranking.more_is_worse(quantity) is not False
        found = [_CurvePlace(cell, point(cell, quantity, factor, self.evidence)) for cell in group]
        found += [
            _CurvePlace(absence.cell, absence, is_high=is_up)
            for absence in absences(around(self.cells, quantity, group), quantity, self.evidence)
            if absence.is_total and absence.cell.key["distance_m"] is not None
        ]
        return sorted(found, key=lambda place: place.metres)

    def _panel(self, title: str, places: Sequence[_CurvePlace], y_label: str, limits: tuple[float, float]) -> Panel:
        found: dict[str, tuple[Identity, list[_CurvePlace]]] = {}
        for place in places:
            identity = self.identities.of(place.cell)
            found.setdefault(identity.label, (identity, []))[1].append(place)
        metres = [place.metres for place in places]
        span = (max(metres) - min(metres)) or 1.0
        middle = (len(found) - 1) / 2
        room = (_MARGIN + middle * _DODGE) * span if len(set(metres)) > 1 else span / 2
        ranked = sorted(found.values(), key=lambda pair: pair[0].rank)
        shifts = [(rank - middle) * _DODGE * span for rank in range(len(ranked))]
        return Panel(
            title=title,
            x_label="distance",
            y_label=y_label,
            series=[
                _series(identity, mine, shift, _ASIDE * span, limits)
                for shift, (identity, mine) in zip(shifts, ranked, strict=True)
            ],
            words=_words(title, y_label, found.values()),
            x_ticks=_ticks(places, span),
            bottom=limits[0],
            top=limits[1],
            left=min(metres) - room,
            right=max(metres) + room,
            edges=[
                EdgeMark(place.metres + shift, place.found.text, identity.style.colour, place.is_high)
                for shift, (identity, mine) in zip(shifts, ranked, strict=True)
                for place in mine
                if isinstance(place.found, Absence)
            ],
        )


def _group(cell: Cell) -> tuple[str, str]:
    return wording.text(cell, "protocol"), wording.text(cell, "topology")


def _capital(label: str) -> str:
    """Return a label as it begins a line; a program is called as it is."""
    return label if label.startswith("iperf3") else label[:1].upper() + label[1:]


def _titled(title: str, quantity: Quantity | None, cells: Sequence[Cell], evidence: Evidence) -> str:
    """Return the title of a panel: with the name of the step among several, and what a ping of this name sent."""
    if quantity is None:
        return title
    sizes = evidence.payloads(cells, quantity.step) if plain_name(quantity.name) == "rtt_median_s" else []
    return ", ".join((quantity.step, title, *sizes))


_NONE: Final = ", dotted where nothing was lost, because each repeat then counts as one trial"
_CUT: Final = "an arrow where an interval continues beyond the axis, where no repeat is drawn"
_LACKING: Final = "a cross at the edge where a condition has no value, and why"
_SOME: Final = "beside a point, how many of the valid repeats have a value, if not all"
_BOUND: Final = "hollow, with an arrow: a lower bound, because something had not ended"
_HOW: Final = {
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
    is_lacking: bool,
) -> str:
    is_none = (
        quantity.unit == "share" and quantity.kind is not Kind.FLAG and any(point.value == 0 for point in points)
    )
    is_cut = any(point.top > limits[point.protocol][1] for point in points)
    parts = (
        f"{_HOW[quantity.kind]}, with its 95 % interval{_NONE if is_none else ''}",
        "" if quantity.kind is Kind.FLAG else "faint: each repeat",
        _CUT if is_cut else "",
        _LACKING if is_lacking else "",
        _SOME if any(point.note for point in points) else "",
        _BOUND if any(any(point.bounds) for point in points) else "",
    )
    return f"{'; '.join(filter(None, parts))}."


def _series(
    identity: Identity, places: Sequence[_CurvePlace], shift: float, aside: float, limits: tuple[float, float]
) -> Series:
    points = [place.found for place in places if isinstance(place.found, Point)]
    is_line = len({point.metres for point in points}) >= _FEWEST_JOINED
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
    """Return the points after which no line is drawn: an interval there says too little, or values are missing."""
    breaks, index = set(), -1
    for place in places:
        if isinstance(place.found, Absence):
            breaks.add(index)
            continue
        index += 1
        if place.found.is_vague(limits):
            breaks |= {index - 1, index}
    return frozenset(breaks)


def _ticks(places: Sequence[_CurvePlace], span: float) -> list[tuple[float, str]]:
    """Return the distances that get a label, as the operator wrote them."""
    chosen: list[tuple[float, str]] = []
    for metres, label in sorted({(place.metres, wording.distance(place.cell)) for place in places}):
        if not chosen or metres - chosen[-1][0] >= _TICKS_APART * span:
            chosen.append((metres, label))
    return chosen


def _words(title: str, y_label: str, series: Iterable[tuple[Identity, list[_CurvePlace]]]) -> str:
    """Return a panel as a sentence per series."""
    said = [
        f"{identity.label or 'all'}: "
        + ", ".join(
            f"{f'{each.found.value:.2f}' if isinstance(each.found, Point) else each.found.text} "
            f"at {wording.distance(each.cell)}"
            for each in places
        )
        for identity, places in series
    ]
    return f"{y_label} against distance, {title}. " + "; ".join(said) + "."
