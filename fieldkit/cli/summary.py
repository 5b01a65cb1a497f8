"""The table of trials for an operator: quantities in rows, protocols in columns."""

from collections.abc import Collection, Sequence

from fieldkit.analysis import lines, wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.lines import TableLine
from fieldkit.cli.display import fits, prose, table

Row = tuple[str, ...]
_Table = tuple[Row, list[Row]]
"""Head and rows of a table."""


def show(cells: Sequence[Cell], *, every: bool = False, expected: Collection[str] = ()) -> int:
    """Print a table per condition, each value with its 95 % interval, and return the number of omitted quantities.

    If the terminal is too narrow for that, each protocol has a separate table; if that is still too wide, intervals
    are below their values and labels are folded.

    Args:
        cells: The cells to show.
        every: True to show all quantities, not only those of `lines.of_operator`.
        expected: Names of quantities with an expectation. They are always shown.
    """
    groups: dict[tuple[str | float | None, ...], list[Cell]] = {}
    for cell in cells:
        condition = tuple(cell.key[name] for name in ("procedure", "distance", "topology", "backend"))
        groups.setdefault(condition, []).append(cell)
    left_out, names = set[str](), set[str]()
    for condition, group in groups.items():
        title = ", ".join(str(part) for part in condition)
        shown = lines.lines(group) if every else lines.with_radio_loss(lines.operator_lines(group, expected), group)
        names |= (group_names := {quantity.name for line in shown for quantity in line.quantities})
        left_out |= {quantity.name for quantity in wording.measured(group)} - group_names
        layouts: Sequence[tuple[list[_Table], Sequence[int]]] = (
            ([_summary(group, shown)], ()),
            ([_summary([cell], shown) for cell in group], ()),
            ([_summary([cell], shown, between="\n") for cell in group], (0,)),
        )
        tables, fold = next((layout for layout in layouts if all(fits(*part) for part in layout[0])), layouts[-1])
        for head, rows in tables:
            table(head, rows, title=title, right=range(1, len(head)), fold=fold)
    for caution in wording.cautions(cells, names):
        prose(caution)
    return len(left_out)


def _summary(group: Sequence[Cell], shown: Sequence[TableLine], between: str = " ") -> _Table:
    """Return the head and the rows of a table of one condition, with `between` between the parts of a cell."""
    figures = [(line.label, *(line.amount(cell, line.scale(group), between) for cell in group)) for line in shown]
    words = [
        (label, *(wording.tally(cell, name, f",{between}") for cell in group))
        for name, label in wording.worded(group).items()
    ]
    sent = [(label, *counts) for label, counts in lines.sent(group).items()]
    rows = [("repeats", *map(wording.counts, group)), *sent, *(row for row in figures if any(row[1:])), *words]
    return ("[95 % interval]", *(str(cell.key["protocol"]).upper() for cell in group)), rows


def more(left_out: int) -> str:
    """Return the number of omitted quantities in words."""
    return f"{left_out} more {'quantity' if left_out == 1 else 'quantities'}"
