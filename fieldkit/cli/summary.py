"""The table of what trials came to, condition by condition."""

from collections.abc import Sequence

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import QUANTITIES, Quantity
from fieldkit.analysis.wording import Scale
from fieldkit.cli.display import table


def summary_table(cells: Sequence[Cell]) -> None:
    """Print per condition a table: measures down, protocols across, each value with its 95 % interval."""
    groups: dict[tuple[str | float | None, ...], list[Cell]] = {}
    for one in cells:
        condition = tuple(one.key[name] for name in ("procedure", "distance", "topology", "backend"))
        groups.setdefault(condition, []).append(one)
    for condition, group in groups.items():
        rows = [
            ("repeats", *map(wording.counts, group)),
            *(
                (wording.label(one), *(_value(cell, one, wording.scale(one, group)) for cell in group))
                for one in wording.shown(group, QUANTITIES)
            ),
        ]
        head = ("[95 % interval]", *(str(one.key["protocol"]).upper() for one in group))
        table(head, rows, title=", ".join(str(part) for part in condition), right=range(1, len(group) + 1))


def _value(one: Cell, quantity: Quantity, scale: Scale) -> str:
    found = one.estimates.get(quantity.name)
    if found is None:
        return ""
    return f"{scale.number(found.value)} {scale.unit} {scale.interval(found.low, found.high)}".rstrip()
