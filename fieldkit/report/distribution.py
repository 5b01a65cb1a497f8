"""Distribution functions of round-trip times and transfer times.

Round-trip times are those of all replies if all outputs of ping are available, otherwise the medians of the repeats.

A cell contains the repeats under one condition, and their estimates.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity, with_plain_name
from fieldkit.analysis.wording import Scale, time_scale
from fieldkit.report import wording
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.series import Identities, needs_log, panels
from fieldkit.report.trial_folders import Evidence

MAX_DISTANCES: Final = 3
"""Maximum number of distances with a panel: the nearest, the middle and the farthest."""
_MARGIN: Final = 1.03
_LOG_MARGIN: Final = 1.1
"""Factor between the ends of an axis and the extreme times."""
_LOG: Final = ", on a logarithmic axis"
MAX_STEPS: Final = 120
"""Maximum number of steps of a line. A line of more times is drawn through their quantiles at multiples of 1/120."""


@dataclass(frozen=True, eq=False)
class _Sample:
    """The times of one cell in seconds, sorted."""

    cell: Cell
    times_s: NDArray[np.float64]


def charts(cells: Sequence[Cell], identities: Identities, evidence: Evidence) -> Iterator[Chart]:
    """Yield the distributions of round-trip time and transfer time from the table and the outputs of ping."""
    for quantity in with_plain_name(evidence.quantities.values(), "rtt_median_s"):
        yield from _round_trips(quantity, cells, identities, evidence)
    for quantity in with_plain_name(evidence.quantities.values(), "transfer_s"):
        name, title = _chart_name("transfer-distribution", quantity), _chart_title("Transfer time", quantity)
        yield from _chart(name, title, "repeats", _repeat_samples(quantity.name, cells, evidence), identities)


def _round_trips(
    quantity: Quantity, cells: Sequence[Cell], identities: Identities, evidence: Evidence
) -> Iterator[Chart]:
    """Yield the distributions of one ping's round-trip times, separately for each payload size."""
    replies = _reply_samples(quantity, cells, evidence)
    title, unit_name = ("Round-trip time", "replies") if replies else ("Median round-trip time", "repeats")
    samples = replies or _repeat_samples(quantity.name, cells, evidence)
    for size in evidence.by_payload(cells, quantity.step):
        same_size = [sample for sample in samples if evidence.payload(sample.cell, quantity.step) == size]
        for chart in _chart(
            _chart_name("rtt-distribution", quantity), _chart_title(title, quantity), unit_name, same_size, identities
        ):
            yield chart.of_size(size)


def _chart_name(chart: str, quantity: Quantity) -> str:
    """Return the name of a chart of one step, for files and links."""
    return "-".join(filter(None, (chart, quantity.step.replace("_", "-").replace(".", "-"))))


def _chart_title(title: str, quantity: Quantity) -> str:
    return f"{title} of {quantity.step}" if quantity.step else title


def _reply_samples(quantity: Quantity, cells: Sequence[Cell], evidence: Evidence) -> list[_Sample] | None:
    """Return all round-trip times of each cell, or None if a repeat with a median has no output of ping."""
    samples = []
    for cell in cells:
        outputs = [evidence.pings(row, quantity.step) for row in evidence.valid_rows(cell, quantity.name).tolist()]
        if None in outputs:
            return None
        samples.append(_Sample(cell, np.sort([rtt_s for output in outputs if output for rtt_s in output.rtt_s])))
    return samples


def _repeat_samples(name: str, cells: Sequence[Cell], evidence: Evidence) -> list[_Sample]:
    numbers = evidence.repeats.numbers[name]
    return [_Sample(cell, np.sort(numbers[evidence.valid_rows(cell, name)])) for cell in cells]


def _chart(
    name: str, title: str, unit_name: str, samples: Sequence[_Sample], identities: Identities
) -> Iterator[Chart]:
    """Yield a chart with a panel per protocol, topology and shown distance; nothing if there are no times."""
    nonempty = [sample for sample in samples if len(sample.times_s)]
    if not nonempty:
        return
    # All lines have the same unit, which fits the line with the smallest maximum.
    scale = time_scale(min(sample.times_s[-1] for sample in nonempty))
    chart_panels = []
    for condition, group in panels([sample.cell for sample in nonempty]).items():
        same_protocol_s = np.concatenate(
            [sample.times_s for sample in nonempty if sample.cell.key["protocol"] == group[0].key["protocol"]]
        )
        is_log = needs_log(same_protocol_s)
        for distance in _shown_distances(group):
            panel_samples = [
                sample for sample in nonempty if sample.cell in group and wording.distance(sample.cell) == distance
            ]
            panel_samples.sort(key=lambda sample: identities.of(sample.cell).rank)
            series = [_series(identities, sample, scale.factor) for sample in panel_samples]
            chart_panels.append(
                Panel(
                    title=f"{condition}, {distance}",
                    x_label=f"{title} [{scale.unit}]",
                    y_label=f"share of {unit_name}",
                    series=series,
                    description=_describe(f"{title}, {condition}, {distance}", panel_samples, identities, scale),
                    top=1.0,
                    left=scale.factor * float(same_protocol_s.min()) / _LOG_MARGIN if is_log else 0.0,
                    right=scale.factor * float(same_protocol_s.max()) * (_LOG_MARGIN if is_log else _MARGIN),
                    x_log=is_log,
                )
            )
    caption = _caption(nonempty, unit_name, is_log=any(panel.x_log for panel in chart_panels))
    yield Chart(name, f"{title}: distribution", caption, chart_panels, is_dense=True)


def _shown_distances(cells: Sequence[Cell]) -> list[str]:
    """Return labels of the distances that get a panel, at most `MAX_DISTANCES`."""
    labels = [label for _, label in sorted({(wording.metres(cell), wording.distance(cell)) for cell in cells})]
    if len(labels) <= MAX_DISTANCES:
        return labels
    return [labels[0], labels[(len(labels) - 1) // 2], labels[-1]]


def _series(identities: Identities, sample: _Sample, factor: float) -> Series:
    identity = identities.of(sample.cell)
    times, shares = _steps(sample.times_s)
    return Series(identity.label, replace(identity.style, marker=""), factor * times, shares, join="steps")


def _steps(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the distribution function: times, and the shares up to each time, from 0 to 1."""
    if len(times) > MAX_STEPS:
        shares = np.linspace(0, 1, MAX_STEPS + 1)
        return np.quantile(times, shares, method="inverted_cdf"), shares
    return np.insert(times, 0, times[0]), np.arange(len(times) + 1) / len(times)


def _describe(title: str, samples: Sequence[_Sample], identities: Identities, scale: Scale) -> str:
    sentences = []
    for sample in samples:
        median, p95 = (f"{scale.number(time_s)} {scale.unit}" for time_s in np.quantile(sample.times_s, (0.5, 0.95)))
        sentences.append(f"{identities.of(sample.cell).label or 'all'}: median {median}, 95 % up to {p95}")
    return f"{title}. " + "; ".join(sentences) + "."


def _caption(samples: Sequence[_Sample], unit_name: str, *, is_log: bool) -> str:
    counts = sorted(len(sample.times_s) for sample in samples)
    count_text = str(counts[0]) if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
    text = (
        f"Share of {unit_name} that took at most this time{_LOG if is_log else ''}; {count_text} {unit_name} per line"
    )
    distances = {wording.distance(sample.cell) for sample in samples}
    if len(distances) > MAX_DISTANCES:
        text += f"; of {len(distances)} distances, only the nearest, a middle one and the farthest are shown"
    if counts[-1] > MAX_STEPS:
        text += f"; a line of more than {MAX_STEPS} {unit_name} is drawn through {MAX_STEPS} quantiles"
    return f"{text}. Requests without a reply are not drawn: see ping loss." if unit_name == "replies" else f"{text}."
