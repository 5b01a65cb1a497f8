"""Charts against distance: a chart per quantity; protocols, topologies and steps that have a name in panels."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity, alike
from fieldkit.analysis.wording import scale_of
from fieldkit.core.columns import plain_name
from fieldkit.report import wording
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.conditions import Identities, Identity, panels
from fieldkit.report.evidence import Evidence

LOSS: Final = ("datagram_loss", "ip_loss", "tcp_byte_loss", "topic_loss", "iperf3_loss", "iperf3_captured_loss")
DELAY: Final = ("rtt_median_s", "one_way_median_s", "delay_s", "transfer_s", "topic_delay_median_s")
RATE: Final = ("goodput_bit_s", "throughput_bit_s", "iperf3_throughput_bit_s")

_LEAST_TOP_PERCENT: Final = 1.0
_MOST_ROOM: Final = 2.0
"""How far the axis goes, as a multiple of the largest value: wider intervals go on above it."""
_DODGE: Final = 0.026
"""Between series at the same distance, as a share of the axis, so that no interval hides another."""
_ASIDE: Final = 0.009
"""Of single repeats, from the interval of their estimate, likewise."""
_FEWEST_JOINED: Final = 4
"""Distances from which on their points are joined: a line through fewer suggests a course that nobody measured."""
_MOST_BEHIND: Final = 100
"""Single repeats behind one estimate; of more, every k-th is drawn."""
_ROOM_AROUND: Final = 0.25
"""Above and below the values of an axis that does not begin at 0, as a share of what they span."""
_MOST_WIDE: Final = 2
"""Panels of a chart of several steps that stand large."""
_MARGIN: Final = 0.06
"""At either end of the axis, likewise."""
_TICKS_APART: Final = 0.16
"""Of the axis, so that no label of a distance runs into another."""


@dataclass(frozen=True)
class _Point:
    """One estimate at one distance, in the unit of the axis."""

    cell: Cell
    protocol: str
    metres: float
    value: float
    low: float | None
    high: float | None
    repeats: tuple[float, ...]

    @property
    def top(self) -> float:
        return max(self.value, *self.repeats, *([] if self.high is None else [self.high]))

    @property
    def bottom(self) -> float:
        return min(self.value, *self.repeats, *([] if self.low is None else [self.low]))


def charts(
    cells: Sequence[Cell], identities: Identities, evidence: Evidence, names: Sequence[str]
) -> Iterator[Chart]:
    """Yield a chart for each of the quantities `names` that was measured at some distance.

    Those of steps that have a name share one, a panel for each step. Round trips of requests of different sizes have
    charts of their own, unless the names of their steps tell them apart: beside each other they would be compared.
    """
    for name in names:
        found = alike(evidence.quantities.values(), name)
        of_steps = {one: measured for one in found if one.step and (measured := _placed(cells, one))}
        for quantity in found:
            if not quantity.step and (measured := _placed(cells, quantity)):
                sizes = evidence.by_payload(measured) if name == "rtt_median_s" else {"": measured}
                for size, same in sizes.items():
                    yield _chart({quantity: same}, identities, evidence).of_size(size)
        if of_steps:
            yield _chart(of_steps, identities, evidence)


def _placed(cells: Sequence[Cell], quantity: Quantity) -> list[Cell]:
    """Return the cells that have a quantity and a distance."""
    return [cell for cell in cells if quantity.name in cell.estimates and cell.key["distance_m"] is not None]


def _chart(measured: Mapping[Quantity, Sequence[Cell]], identities: Identities, evidence: Evidence) -> Chart:
    """Return a chart of the cells that have a quantity, or the same one of several steps."""
    quantity, several = next(iter(measured)), len(measured) > 1
    values = [cell.estimates[one.name].value for one, cells in measured.items() for cell in cells]
    written = scale_of(quantity, values)
    groups = {
        _titled(title, one if several else None, group, evidence): [
            _point(cell, one, written.factor, evidence) for cell in group
        ]
        for one, cells in measured.items()
        for title, group in panels(cells).items()
    }
    label = quantity.label if quantity.step and not several else _capital(quantity.plain_label)
    y_label = f"{label} [{written.unit}]" if written.unit else label
    every = [point for points in groups.values() for point in points]
    ends = {protocol: _ends(every, protocol, written.unit) for protocol in {point.protocol for point in every}}
    is_none = quantity.unit == "share" and any(point.value == 0 for point in every)
    is_cut = any(point.top > ends[point.protocol][1] for point in every)
    name = plain_name(quantity.name).removesuffix("_s").removesuffix("_bit").replace("_", "-")
    return Chart(
        name=f"{name}-of-steps" if quantity.step else name,
        title=f"{label} against distance{', by step' if several else ''}",
        caption=(
            f"{_HOW[quantity.kind]}, with its 95 % interval{_NONE if is_none else ''}; "
            f"faint: each repeat{_CUT if is_cut else ''}."
        ),
        panels=[
            _panel(title, points, identities, y_label=y_label, ends=ends[points[0].protocol])
            for title, points in groups.items()
        ],
        is_dense=several and len(groups) > _MOST_WIDE,
    )


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
_CUT: Final = "; an arrow where an interval goes on above the axis, beyond which no repeat is drawn"
_HOW: Final = {
    "counted": "Share of all that was sent",
    "mean": "Mean over repeats",
    "median": "Median over repeats",
    "flag": "Share of the repeats",
}


def _point(cell: Cell, quantity: Quantity, factor: float, evidence: Evidence) -> _Point:
    found = cell.estimates[quantity.name]
    low, high = (None if end is None else factor * end for end in (found.low, found.high))
    rows = evidence.valid(cell, quantity.name)
    repeats = factor * evidence.repeats.numbers[quantity.name][rows[:: -(-len(rows) // _MOST_BEHIND)]]
    protocol = wording.text(cell, "protocol")
    return _Point(cell, protocol, wording.metres(cell), factor * found.value, low, high, tuple(repeats.tolist()))


def _ends(points: Sequence[_Point], protocol: str, unit: str) -> tuple[float, float]:
    """Return the ends of the y axis that panels of one protocol share, so that they can be compared."""
    same = [point for point in points if point.protocol == protocol]
    if min(point.bottom for point in same) < 0:
        return _around([value for point in same for value in (point.value, *point.repeats)])
    largest, highest = max(point.value for point in same), max(point.top for point in same)
    top = min(highest, _MOST_ROOM * largest) if largest > 0 else highest
    return 0.0, max(1.08 * top, _LEAST_TOP_PERCENT if unit == "%" else 0.0) or 1.0


def _around(values: Sequence[float]) -> tuple[float, float]:
    """Return the ends of an axis that does not begin at 0, as one of dBm does not."""
    low, high = min(values), max(values)
    room = _ROOM_AROUND * (high - low) or 1.0
    return low - room, high + room


def _panel(
    title: str, points: Sequence[_Point], identities: Identities, *, y_label: str, ends: tuple[float, float]
) -> Panel:
    found: dict[str, tuple[Identity, list[_Point]]] = {}
    for point in sorted(points, key=lambda one: one.metres):
        identity = identities.of(point.cell)
        found.setdefault(identity.label, (identity, []))[1].append(point)
    metres = [point.metres for point in points]
    span = (max(metres) - min(metres)) or 1.0
    middle = (len(found) - 1) / 2
    room = (_MARGIN + middle * _DODGE) * span if len(set(metres)) > 1 else span / 2
    return Panel(
        title=title,
        x_label="distance",
        y_label=y_label,
        series=[
            _series(identity, mine, (rank - middle) * _DODGE * span, _ASIDE * span)
            for rank, (identity, mine) in enumerate(sorted(found.values(), key=lambda pair: pair[0].rank))
        ],
        words=_words(title, y_label, found.values()),
        x_ticks=_ticks(points, span),
        bottom=ends[0],
        top=ends[1],
        left=min(metres) - room,
        right=max(metres) + room,
    )


def _series(identity: Identity, points: Sequence[_Point], shift: float, aside: float) -> Series:
    return Series(
        label=identity.label,
        style=identity.style,
        x=[point.metres + shift for point in points],
        y=[point.value for point in points],
        low=[point.low for point in points],
        high=[point.high for point in points],
        join="line" if len({point.metres for point in points}) >= _FEWEST_JOINED else "none",
        behind=[(point.metres + shift - aside, value) for point in points for value in point.repeats],
    )


def _ticks(points: Sequence[_Point], span: float) -> list[tuple[float, str]]:
    """Return the distances that get a label, as the operator wrote them with metres below."""
    chosen: list[tuple[float, str]] = []
    for metres, label in sorted({(point.metres, wording.text(point.cell, "distance")) for point in points}):
        if not chosen or metres - chosen[-1][0] >= _TICKS_APART * span:
            below = f"{metres:.1f} m"
            chosen.append((metres, below if label.endswith("m") or not label else f"{label}\n{below}"))
    return chosen


def _words(title: str, y_label: str, series: Iterable[tuple[Identity, list[_Point]]]) -> str:
    """Return a panel as a sentence per series."""
    said = [
        f"{identity.label or 'all'}: "
        + ", ".join(f"{point.value:.2f} at {wording.distance(point.cell)}" for point in points)
        for identity, points in series
    ]
    return f"{y_label} against distance, {title}. " + "; ".join(said) + "."
