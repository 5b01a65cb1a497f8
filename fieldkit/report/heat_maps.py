"""Heat maps of a sweep: a quantity over two of its factors, one map per flow and combination of the other factors."""

import math
from collections.abc import Iterator, Sequence
from typing import Final

from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.wording import Scale, scale_of
from fieldkit.core import columns
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import parse_distance
from fieldkit.report.charts import Chart, HeatMap, Panel

_DRAWN: Final = ("datagram_loss", "rtt_loss", "byte_loss", "one_way_median_s", "rtt_median_s", "added_delay_mean_s")
"""Quantities that are drawn by default."""
_MAX_PANELS: Final = 12


def charts(repeats: Repeats, condition: Sequence[str], requested: Sequence[str] = ()) -> Iterator[Chart]:
    """Yield a chart per quantity; none if fewer than two factors have several values.

    Args:
        repeats: The runs of sweeps.
        condition: The columns of the flow and of the factors.
        requested: Names of quantities that are drawn in any case.
    """
    flow, *factors = condition
    varied = [name for name in factors if len(set(repeats.column(name))) > 1]
    if len(varied) < 2:
        return
    names = (*_DRAWN, *(name for name in requested if name not in _DRAWN))
    quantities = [quantity for quantity in repeats.quantities if quantity.name in names]
    cells = aggregate(repeats, (flow, *factors), quantities=quantities, words=())
    for quantity in quantities:
        measured = [cell for cell in cells if quantity.name in cell.estimates]
        if measured and (
            quantity.name in requested or len({cell.estimates[quantity.name].value for cell in measured}) > 1
        ):
            yield _chart(quantity, measured, (varied[0], varied[1]), (flow, *varied[2:]))


def _chart(quantity: Quantity, cells: Sequence[Cell], axes: tuple[str, str], others: Sequence[str]) -> Chart:
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        title = ", ".join(
            columns.cell(cell.key[name]) if name == others[0] else f"{name} {columns.cell(cell.key[name])}"
            for name in others
        )
        groups.setdefault(title, []).append(cell)
    values = [cell.estimates[quantity.name].value for cell in cells]
    scale = scale_of(quantity, values)
    panels = [
        _panel(title, quantity, group, axes=axes, scale=scale, limits=(min(values), max(values)))
        for title, group in list(groups.items())[:_MAX_PANELS]
    ]
    omitted = len(groups) - len(panels)
    caption = "Estimates over the valid seeds; the table has their intervals."
    if omitted:
        caption += f" {omitted} more maps are left out."
    title = f"{scale.head(quantity.label)} over {axes[0]} and {axes[1]}"
    return Chart(f"map-{quantity.name}".replace(".", "-"), title, caption, panels)


def _panel(
    title: str,
    quantity: Quantity,
    cells: Sequence[Cell],
    *,
    axes: tuple[str, str],
    scale: Scale,
    limits: tuple[float, float],
) -> Panel:
    across, up = (sorted({cell.key[name] for cell in cells}, key=_order) for name in axes)
    values = [[math.nan] * len(across) for _ in up]
    for cell in cells:
        row, column = up.index(cell.key[axes[1]]), across.index(cell.key[axes[0]])
        values[row][column] = cell.estimates[quantity.name].value
    texts = [["" if math.isnan(value) else scale.number(value) for value in row] for row in values]
    across_labels, up_labels = ([columns.cell(key) for key in keys] for keys in (across, up))
    heat = HeatMap(across_labels, up_labels, values, texts, limits)
    words = "; ".join(
        f"{axes[0]} {x}, {axes[1]} {y}: {text} {scale.unit}"
        for y, row in zip(heat.rows, texts, strict=True)
        for x, text in zip(heat.columns, row, strict=True)
        if text
    )
    return Panel(title, axes[0], axes[1], (), f"{quantity.label}, {title}. {words}", heat=heat)


def _order(key: str | float | None) -> tuple[bool, float, str]:
    """Return the sort key of a factor's value: numbers and distances by their value, other texts by the alphabet."""
    if not isinstance(key, str):
        return False, key or 0.0, ""
    try:
        return False, parse_distance(key).metres, key
    except ConfigurationError:
        return True, 0.0, key
