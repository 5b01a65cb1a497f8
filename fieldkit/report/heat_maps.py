"""Heat maps of a sweep: a quantity over two of its factors, one map per flow and combination of the other factors.

A sweep runs a simulation with several values of each factor. A flow is a stream of packets and its receiver.

A cell contains the repeats under one condition, and their estimates.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.wording import Scale, scale_of
from fieldkit.core import columns
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import parse_distance
from fieldkit.report.charts import Chart, HeatMap, Panel

_DEFAULT_NAMES: Final = (
    "datagram_loss",
    "rtt_loss",
    "byte_loss",
    "one_way_median_s",
    "rtt_median_s",
    "added_delay_mean_s",
)
"""Quantities that are drawn without a request, if their values differ."""
_MAX_PANELS: Final = 12
"""Maximum number of maps of a quantity."""


@dataclass(frozen=True)
class _Axis:
    """An axis of a map.

    Attributes:
        column: The column of its values.
        name: The name that is shown.
        labels: The labels of its values, as the user typed them.
    """

    column: str
    name: str
    labels: Mapping[str | float | None, str]


def charts(
    repeats: Repeats, sweep: Mapping[str, str], requested: Sequence[str] = (), *, one_factor: bool = False
) -> Iterator[Chart]:
    """Yield a chart for each measured quantity that is drawn by default or requested.

    Quantities whose values are all equal are drawn only if they are requested. The axes are the first two factors
    with several values. Nothing is yielded if there are too few such factors.

    Args:
        repeats: The runs of sweeps.
        sweep: The columns of the flow and of the factors, each with the column that contains its values as the user
            typed them; see `datasets.condition`.
        requested: Names of quantities that are drawn even if all their values are equal.
        one_factor: True if one factor with several values is enough: the other axis is then the flow. Otherwise at
            least two factors with several values are needed.
    """
    flow, *factors = sweep
    varied_factors = [name for name in factors if len(set(repeats.column(name))) > 1]
    if len(varied_factors) == 1 and one_factor:
        varied_factors.append(flow)
    if len(varied_factors) < 2:
        return
    all_axes = {
        name: _Axis(name, sweep[name], _labels(repeats, name, sweep[name])) for name in (flow, *varied_factors)
    }
    axes = [all_axes.pop(name) for name in varied_factors[:2]]
    names = (*_DEFAULT_NAMES, *(name for name in requested if name not in _DEFAULT_NAMES))
    quantities = [quantity for quantity in repeats.quantities if quantity.name in names]
    cells = aggregate(repeats, (flow, *factors), quantities=quantities, words=())
    for quantity in quantities:
        measured_cells = [cell for cell in cells if quantity.name in cell.estimates]
        if measured_cells and (
            quantity.name in requested or len({cell.estimates[quantity.name].value for cell in measured_cells}) > 1
        ):
            yield _chart(quantity, measured_cells, axes, list(all_axes.values()))


def _labels(repeats: Repeats, name: str, text: str) -> dict[str | float | None, str]:
    """Return the text that the user typed, for each value of the column `name`."""
    return {
        value: columns.cell_text(label)
        for value, label in zip(repeats.column(name), repeats.column(text), strict=True)
    }


def _chart(quantity: Quantity, cells: Sequence[Cell], axes: Sequence[_Axis], others: Sequence[_Axis]) -> Chart:
    """Return the chart of a quantity: a map for each combination of the values of the axes `others`."""
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        labels = [(axis.name, axis.labels[cell.key[axis.column]]) for axis in others]
        # The first label is the flow, which needs no name.
        title = ", ".join(label if number == 0 else f"{name} {label}" for number, (name, label) in enumerate(labels))
        groups.setdefault(title, []).append(cell)
    values = [cell.estimates[quantity.name].value for cell in cells]
    scale = scale_of(quantity, values)
    panels = [
        _panel(title, quantity, group, axes=axes, scale=scale, limits=(min(values), max(values)))
        for title, group in list(groups.items())[:_MAX_PANELS]
    ]
    omitted_count = len(groups) - len(panels)
    caption = "Each value is an estimate over the valid runs, one per seed; the table has its interval."
    if omitted_count:
        caption += f" {omitted_count} more {'map is' if omitted_count == 1 else 'maps are'} left out."
    title = f"{scale.head(quantity.label)} over {axes[0].name} and {axes[1].name}"
    return Chart(f"map-{quantity.name}".replace(".", "-"), title, caption, panels)


def _panel(
    title: str,
    quantity: Quantity,
    cells: Sequence[Cell],
    *,
    axes: Sequence[_Axis],
    scale: Scale,
    limits: tuple[float, float],
) -> Panel:
    x_keys, y_keys = (sorted({cell.key[axis.column] for cell in cells}, key=_order) for axis in axes)
    values = [[math.nan] * len(x_keys) for _ in y_keys]
    for cell in cells:
        row, column = y_keys.index(cell.key[axes[1].column]), x_keys.index(cell.key[axes[0].column])
        values[row][column] = cell.estimates[quantity.name].value
    texts = [["" if math.isnan(value) else scale.number(value) for value in row] for row in values]
    x_labels, y_labels = (
        [axis.labels[key] for key in keys] for axis, keys in zip(axes, (x_keys, y_keys), strict=True)
    )
    heat = HeatMap(x_labels, y_labels, values, texts, limits)
    value_texts = "; ".join(
        f"{axes[0].name} {x}, {axes[1].name} {y}: {text} {scale.unit}"
        for y, row in zip(heat.rows, texts, strict=True)
        for x, text in zip(heat.columns, row, strict=True)
        if text
    )
    return Panel(title, axes[0].name, axes[1].name, (), f"{quantity.label}, {title}. {value_texts}", heat=heat)


def _order(key: str | float | None) -> tuple[bool, float, str]:
    """Return the sort key of a factor's value: numbers and distances by value, other texts alphabetically."""
    if not isinstance(key, str):
        return False, key or 0.0, ""
    try:
        return False, parse_distance(key).metres, key
    except ConfigurationError:
        return True, 0.0, key
