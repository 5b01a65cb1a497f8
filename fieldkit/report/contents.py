"""All that stands in a report, put together from a table of repeats and the evidence beside it."""

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import QUANTITIES, Quantity, of_fault
from fieldkit.analysis.repeats import Repeats
from fieldkit.core.model import FaultKind
from fieldkit.report import against, bursts, choice, distribution, provenance, strips, summary, timeline, wording
from fieldkit.report.charts import Chart
from fieldkit.report.conditions import Identities
from fieldkit.report.evidence import Evidence, at_hand

_QUOTED: Final = frozenset(
    (
        *against.LOSS,
        "file_loss",
        *against.DELAY,
        *(of_fault(kind, what) for kind in FaultKind for what in ("recovered", "recovery_s")),
    )
)
"""What stands in the tables at once; the rest is folded away."""


@dataclass(frozen=True)
class Table:
    """Cells of one protocol with the quantities that any of them has.

    Attributes:
        title: The protocol.
        quantities: Columns: what is quoted.
        more: Further ones.
        lines: Cells, each with what tells it from the others.
    """

    title: str
    quantities: Sequence[Quantity]
    more: Sequence[Quantity]
    lines: Sequence[tuple[str, Cell]]


@dataclass(frozen=True)
class Section:
    """Charts under one heading.

    Attributes:
        name: For links.
        title: The heading.
        charts: At least one.
    """

    name: str
    title: str
    charts: Sequence[Chart]


@dataclass(frozen=True)
class Contents:
    """What stands in a report.

    Attributes:
        title: Its title.
        paragraph: What was run, in words.
        headlines: The figures that matter most.
        warnings: What to know before quoting one.
        tables: Cells, a table per protocol.
        sections: Figures.
        strips: Attempts in order of time.
        bursts: The packets of repeats whose captures are at hand.
        trials: Where all that comes from.
        evidence: What is at hand.
        command: What makes this report again.
    """

    title: str
    paragraph: str
    headlines: Sequence[str]
    warnings: Sequence[str]
    tables: Sequence[Table]
    sections: Sequence[Section]
    strips: Sequence[strips.Group]
    bursts: Sequence[bursts.Group]
    trials: Sequence[provenance.Trial]
    evidence: Evidence
    command: str

    @property
    def versions(self) -> dict[str, int]:
        """How many trials ran with each set of versions, where that is known."""
        return Counter(trial.versions for trial in self.trials if trial.versions)


def put_together(repeats: Repeats, *, title: str, repeat: str, command: Sequence[str]) -> Contents:
    """Return the contents of a report on `repeats`.

    Args:
        repeats: Attempts, with the column `source`.
        title: Its title; empty to make one.
        repeat: Whose time line is drawn, as `choice.chosen`.
        command: The words that the operator typed, but for `--rebuild`.
    """
    evidence = at_hand(repeats)
    is_whole = evidence.plans.keys() == set(repeats.texts["source"].tolist())
    cells = sorted(aggregate(repeats), key=_order)
    identities = Identities(cells)
    row = choice.chosen(cells, evidence, repeat)
    sections = (
        Section("loss", "Loss against distance", list(against.charts(cells, identities, against.LOSS))),
        Section("delay", "Delay against distance", list(against.charts(cells, identities, against.DELAY))),
        Section("distributions", "Distributions", list(distribution.charts(cells, identities, evidence))),
        Section("one-repeat", "One repeat", [] if row is None else list(timeline.charts(row, evidence))),
    )
    return Contents(
        title=title or summary.title(cells),
        paragraph=summary.paragraph(cells, evidence),
        headlines=list(summary.headlines(cells)),
        warnings=list(summary.warnings(cells, evidence)),
        tables=_tables(cells),
        sections=[section for section in sections if section.charts],
        strips=list(strips.groups(cells, identities, evidence)),
        bursts=list(bursts.groups(cells, evidence)),
        trials=list(provenance.trials(evidence)),
        evidence=evidence,
        command=shlex.join([*command, "--rebuild"] if is_whole else command),
    )


def _order(cell: Cell) -> tuple[str | float, ...]:
    names = ("protocol", "topology", "scenario", "procedure")
    return *(wording.text(cell, name) for name in names), wording.metres(cell), wording.text(cell, "backend")


def _tables(cells: Sequence[Cell]) -> list[Table]:
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(wording.text(cell, "protocol").upper(), []).append(cell)
    told = wording.differing(cells)
    tables = []
    for title, group in groups.items():
        known = [one for one in QUANTITIES if any(one.name in cell.estimates for cell in group)]
        tables.append(
            Table(
                title=title,
                quantities=[one for one in known if one.name in _QUOTED],
                more=[one for one in known if one.name not in _QUOTED],
                lines=[(wording.place(cell, told=told), cell) for cell in group],
            )
        )
    return tables
