"""Tables of a report: the cells of each protocol, with their quantities and with reasons for missing figures."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.wording import measured as measured_in
from fieldkit.analysis.wording import word_labels
from fieldkit.core.columns import fault_column_name, plain_name
from fieldkit.core.model import FaultKind
from fieldkit.report import distance, wording
from fieldkit.report.coverage import total_absences
from fieldkit.report.headlines import Ranking
from fieldkit.report.trial_folders import Evidence

FIRST: Final = "expected and lab-defined figures"
"""Heading of charts and tables of quantities with an expectation, and of user-defined quantities."""

_ALWAYS_VISIBLE: Final = frozenset(
    (
        *distance.LOSS,
        "file_loss",
        *distance.DELAY,
        *distance.RATE,
        *(fault_column_name(kind, what) for kind in FaultKind for what in ("recovered", "recovery_s")),
    )
)
"""Quantities that are always visible in tables. The others are collapsed."""
_MAX_IN_TABLE: Final = 8
"""Maximum number of visible columns in a table without quantities that are always visible."""


@dataclass(frozen=True)
class CellTable:
    """Cells of one protocol, with each quantity that any of them has. Each named step has a separate table.

    Attributes:
        title: The protocol, and the step.
        quantities: Quantities of the visible columns.
        collapsed_quantities: Quantities of collapsed columns.
        lines: Cells, each with the part of its condition in which the cells differ.
        notes: Text below the name of a quantity.
        words: Labels of text columns, by name of the column.
        missing: Reason for a missing figure, by the number of the line and the name of the quantity.
    """

    title: str
    quantities: Sequence[Quantity]
    collapsed_quantities: Sequence[Quantity]
    lines: Sequence[tuple[str, Cell]]
    notes: Mapping[str, str]
    words: Mapping[str, str] = field(default_factory=dict)
    missing: Mapping[tuple[int, str], str] = field(default_factory=dict)


def cell_tables(cells: Sequence[Cell], evidence: Evidence) -> list[CellTable]:
    """Return the tables of all protocols; their lines are in the order of `cells`."""
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(wording.text(cell, "protocol").upper(), []).append(cell)
    differing = wording.differing(cells)
    ranking = Ranking(evidence)
    return [
        replace(table, missing=_missing_reasons(table, evidence))
        for title, group in groups.items()
        for table in _tables_of_protocol(title, group, differing, evidence, ranking)
    ]


def _missing_reasons(table: CellTable, evidence: Evidence) -> dict[tuple[int, str], str]:
    """Return the reasons for missing figures, by line and name of the quantity."""
    cells = [cell for _, cell in table.lines]
    numbers = {id(cell): number for number, cell in enumerate(cells)}
    return {
        (numbers[id(absence.cell)], quantity.name): absence.text
        for quantity in (*table.quantities, *table.collapsed_quantities)
        for absence in total_absences(cells, quantity, evidence)
    }


def _tables_of_protocol(
    title: str, cells: Sequence[Cell], differing: Collection[str], evidence: Evidence, ranking: Ranking
) -> Iterator[CellTable]:
    """Yield the tables of one protocol: expected and user-defined quantities, built-in ones, steps, words."""
    lines = [(wording.place(cell, differing=differing), cell) for cell in cells]
    words = word_labels(cells)
    first = ranking.first_quantities(measured_in(cells))
    if user_defined_words := {name: label for name, label in words.items() if ranking.is_user_defined(name)}:
        words = {name: label for name, label in words.items() if name not in user_defined_words}
    if first or user_defined_words:
        yield CellTable(
            f"{title}, {FIRST}", first, (), lines, _ping_sizes(first, cells, evidence), user_defined_words
        )
    remaining = [quantity for quantity in measured_in(cells) if quantity not in first]
    for step in dict.fromkeys(("", *(quantity.step for quantity in remaining))):
        builtin = [quantity for quantity in remaining if quantity.step == step and quantity.is_builtin]
        other_quantities = [quantity for quantity in remaining if quantity.step == step and not quantity.is_builtin]
        # If no quantity is always visible, the first ones are visible.
        visible = [quantity for quantity in builtin if plain_name(quantity.name) in _ALWAYS_VISIBLE] or builtin[
            :_MAX_IN_TABLE
        ]
        collapsed_quantities = [quantity for quantity in builtin if quantity not in visible]
        if builtin or (not step and not remaining and not first):
            yield CellTable(
                ", ".join(filter(None, (title, step))),
                visible,
                collapsed_quantities,
                lines,
                _ping_sizes(visible, cells, evidence),
            )
        if other_quantities:
            title_text = ", ".join(filter(None, (title, step, "further figures")))
            yield CellTable(title_text, other_quantities[:_MAX_IN_TABLE], other_quantities[_MAX_IN_TABLE:], lines, {})
    if words:
        yield CellTable(f"{title}, words", (), (), lines, {}, words)


def _ping_sizes(quantities: Sequence[Quantity], cells: Sequence[Cell], evidence: Evidence) -> dict[str, str]:
    """Return the ping payload sizes below the names of round-trip times."""
    return {
        quantity.name: ", ".join(evidence.payloads(cells, quantity.step))
        for quantity in quantities
        if plain_name(quantity.name) == "rtt_median_s"
    }
