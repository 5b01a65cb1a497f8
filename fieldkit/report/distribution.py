"""Distribution functions: of each round trip where ping's own lines are at hand, else of the repeats."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity, alike
from fieldkit.analysis.wording import Scale, time_scale
from fieldkit.report import wording
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.conditions import Identities, panels
from fieldkit.report.evidence import Evidence
from fieldkit.report.points import needs_log

MOST_DISTANCES: Final = 3
"""In panels: the nearest, the middle and the farthest."""
_ROOM: Final = 1.03
_LOG_ROOM: Final = 1.1
"""Factor beyond the extreme times of an axis."""
_LOG: Final = ", on a logarithmic axis"
MOST_STEPS: Final = 120
"""Of a line; a longer one is drawn through as many of its quantiles."""


@dataclass(frozen=True, eq=False)
class _Sample:
    """What one cell gives to a distribution: times in seconds, sorted."""

    cell: Cell
    times_s: NDArray[np.float64]


def charts(cells: Sequence[Cell], identities: Identities, evidence: Evidence) -> Iterator[Chart]:
    """Yield the distributions of round-trip time and transfer time that the table and ping's output give."""
    for one in alike(evidence.quantities.values(), "rtt_median_s"):
        yield from _round_trips(one, cells, identities, evidence)
    for one in alike(evidence.quantities.values(), "transfer_s"):
        name, title = _named("transfer-distribution", one), _said("Transfer time", one)
        yield from _chart(name, title, "repeats", _column(one.name, cells, evidence), identities)


def _round_trips(
    quantity: Quantity, cells: Sequence[Cell], identities: Identities, evidence: Evidence
) -> Iterator[Chart]:
    """Yield the distributions of one ping's round-trip times, those of each size of requests by themselves."""
    replies = _replies(quantity, cells, evidence)
    title, of = ("Round-trip time", "replies") if replies else ("Median round-trip time", "repeats")
    samples = replies or _column(quantity.name, cells, evidence)
    for size in evidence.by_payload(cells, quantity.step):
        mine = [one for one in samples if evidence.payload(one.cell, quantity.step) == size]
        for chart in _chart(_named("rtt-distribution", quantity), _said(title, quantity), of, mine, identities):
            yield chart.of_size(size)


def _named(chart: str, quantity: Quantity) -> str:
    """Return the name of a chart of one step, which files and links are called by."""
    return "-".join(filter(None, (chart, quantity.step.replace("_", "-").replace(".", "-"))))


def _said(title: str, quantity: Quantity) -> str:
    return f"{title} of {quantity.step}" if quantity.step else title


def _replies(quantity: Quantity, cells: Sequence[Cell], evidence: Evidence) -> list[_Sample] | None:
    """Return every round trip of each cell; None where ping's output is missing for a repeat that has a median."""
    samples = []
    for cell in cells:
        said = [evidence.pings(row, quantity.step) for row in evidence.valid(cell, quantity.name).tolist()]
        if None in said:
            return None
        samples.append(_Sample(cell, np.sort([rtt_s for one in said if one for rtt_s in one.rtt_s])))
    return samples


def _column(name: str, cells: Sequence[Cell], evidence: Evidence) -> list[_Sample]:
    numbers = evidence.repeats.numbers[name]
    return [_Sample(cell, np.sort(numbers[evidence.valid(cell, name)])) for cell in cells]


def _chart(name: str, title: str, of: str, samples: Sequence[_Sample], identities: Identities) -> Iterator[Chart]:
    known = [one for one in samples if len(one.times_s)]
    if not known:
        return
    # In one unit, in which also the shortest can be read.
    scale = time_scale(min(one.times_s[-1] for one in known))
    found = []
    for condition, group in panels([one.cell for one in known]).items():
        alike_s = np.concatenate(
            [one.times_s for one in known if one.cell.key["protocol"] == group[0].key["protocol"]]
        )
        is_log = needs_log(alike_s)
        for place in _places(group):
            there = [one for one in known if one.cell in group and wording.distance(one.cell) == place]
            there.sort(key=lambda one: identities.of(one.cell).rank)
            series = [_series(identities, one, scale.factor) for one in there]
            found.append(
                Panel(
                    title=f"{condition}, {place}",
                    x_label=f"{title} [{scale.unit}]",
                    y_label=f"share of {of}",
                    series=series,
                    words=_words(f"{title}, {condition}, {place}", there, identities, scale),
                    top=1.0,
                    left=scale.factor * float(alike_s.min()) / _LOG_ROOM if is_log else 0.0,
                    right=scale.factor * float(alike_s.max()) * (_LOG_ROOM if is_log else _ROOM),
                    x_log=is_log,
                )
            )
    caption = _caption(known, of, is_log=any(panel.x_log for panel in found))
    yield Chart(name, f"{title}: distribution", caption, found, is_dense=True)


def _places(cells: Sequence[Cell]) -> list[str]:
    """Return the distances that get a panel, in words: at most `MOST_DISTANCES`."""
    places = [said for _, said in sorted({(wording.metres(cell), wording.distance(cell)) for cell in cells})]
    if len(places) <= MOST_DISTANCES:
        return places
    return [places[0], places[(len(places) - 1) // 2], places[-1]]


def _series(identities: Identities, sample: _Sample, factor: float) -> Series:
    identity = identities.of(sample.cell)
    times, shares = _steps(sample.times_s)
    return Series(identity.label, replace(identity.style, marker=""), factor * times, shares, join="steps")


def _steps(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the distribution function: shares up to each time, from 0 to 1."""
    if len(times) > MOST_STEPS:
        shares = np.linspace(0, 1, MOST_STEPS + 1)
        return np.quantile(times, shares, method="inverted_cdf"), shares
    return np.insert(times, 0, times[0]), np.arange(len(times) + 1) / len(times)


def _words(title: str, samples: Sequence[_Sample], identities: Identities, scale: Scale) -> str:
    said = []
    for one in samples:
        half, most = (f"{scale.number(time_s)} {scale.unit}" for time_s in np.quantile(one.times_s, (0.5, 0.95)))
        said.append(f"{identities.of(one.cell).label or 'all'}: median {half}, 95 % up to {most}")
    return f"{title}. " + "; ".join(said) + "."


def _caption(samples: Sequence[_Sample], of: str, *, is_log: bool) -> str:
    counts = sorted(len(one.times_s) for one in samples)
    many = str(counts[0]) if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
    said = f"Share of {of} that took at most this time{_LOG if is_log else ''}; {many} {of} per line"
    places = {wording.distance(one.cell) for one in samples}
    if len(places) > MOST_DISTANCES:
        said += f"; of {len(places)} distances the nearest, a middle one and the farthest"
    if counts[-1] > MOST_STEPS:
        said += f"; lines of more than {MOST_STEPS} go through as many quantiles"
    return f"{said}. Requests without a reply are in no line: see ping loss." if of == "replies" else f"{said}."
