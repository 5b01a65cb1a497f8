"""All that stands in a report, put together from a table of repeats and the evidence beside it."""

import shlex
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import LOSSES, Quantity, alike
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.wording import measured as measured_in
from fieldkit.analysis.wording import worded
from fieldkit.core.columns import of_fault, plain_name
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FaultKind
from fieldkit.report import (
    bursts,
    distance,
    distribution,
    dots,
    expected,
    provenance,
    strips,
    summary,
    timeline,
    wording,
)
from fieldkit.report.charts import Chart
from fieldkit.report.conditions import Identities
from fieldkit.report.coverage import absences
from fieldkit.report.evidence import Evidence, at_hand
from fieldkit.report.headlines import Headline, headlines
from fieldkit.report.ranking import Ranking

_QUOTED: Final = frozenset(
    (
        *distance.LOSS,
        "file_loss",
        *distance.DELAY,
        *distance.RATE,
        *(of_fault(kind, what) for kind in FaultKind for what in ("recovered", "recovery_s")),
    )
)
"""What stands in the tables at once; the rest is folded away."""


_FIRST: Final = "expected and own figures"
"""Quantities of which a trial expects something, and those that a lab declares itself."""
_SECTIONS: Final = (("loss", distance.LOSS), ("delay", distance.DELAY), ("rate", distance.RATE))
_MOST_FURTHER: Final = 12
"""Charts of quantities that are not fieldkit's own."""
_MOST_IN_TABLE: Final = 8
"""Of these in a table at once."""


@dataclass(frozen=True)
class CellTable:
    """Cells of one protocol with the quantities that any of them has, of one step where that has a name.

    Attributes:
        title: The protocol, and the step.
        quantities: Columns: what is quoted.
        more: Further ones.
        lines: Cells, each with what tells it from the others.
        notes: What stands below the name of a quantity.
        words: Labels of columns of words, by name.
        missing: Why a cell of the table has no figure, by the number of its line and the name of its quantity.
    """

    title: str
    quantities: Sequence[Quantity]
    more: Sequence[Quantity]
    lines: Sequence[tuple[str, Cell]]
    notes: Mapping[str, str]
    words: Mapping[str, str] = field(default_factory=dict)
    missing: Mapping[tuple[int, str], str] = field(default_factory=dict)


@dataclass(frozen=True)
class ChartSection:
    """Charts under one heading.

    Attributes:
        name: For links.
        title: The heading.
        charts: At least one.
        note: What is left out, and how to have it.
    """

    name: str
    title: str
    charts: Sequence[Chart]
    note: str = ""


@dataclass(frozen=True)
class Contents:
    """What stands in a report.

    Attributes:
        title: Its title.
        paragraph: What was run, in words.
        headlines: The figures that matter most.
        warnings: What to know before quoting one.
        verdicts: Whether each expectation holds, condition by condition.
        against_distance: The figures that matter most.
        tables: Cells, a table per protocol.
        sections: Further figures.
        strips: Attempts in order of time.
        bursts: The packets of repeats whose captures are at hand.
        trials: Where all that comes from.
        evidence: What is at hand.
        command: What makes this report again.
    """

    title: str
    paragraph: str
    headlines: Sequence[Headline]
    warnings: Sequence[summary.Caution]
    verdicts: Mapping[str, Sequence[expected.JudgementRow]]
    against_distance: Sequence[ChartSection]
    tables: Sequence[CellTable]
    sections: Sequence[ChartSection]
    strips: Sequence[strips.StripGroup]
    bursts: Sequence[bursts.RasterGroup]
    trials: Sequence[provenance.Provenance]
    evidence: Evidence
    command: str

    @property
    def charts(self) -> list[Chart]:
        """The charts of all sections."""
        return [chart for section in (*self.against_distance, *self.sections) for chart in section.charts]

    @property
    def versions(self) -> dict[str, int]:
        """How many trials ran with each set of versions, where that is known."""
        return Counter(trial.versions for trial in self.trials if trial.versions)


def put_together(
    repeats: Repeats,
    *,
    title: str,
    repeat: str,
    command: Sequence[str],
    quantities: Sequence[str] = (),
    unmeasured: Sequence[str] = (),
) -> Contents:
    """Return the contents of a report on `repeats`.

    Args:
        repeats: Attempts, with the column `source`.
        title: Its title; empty to make one.
        repeat: Whose time line is drawn, as `repeat_to_draw`.
        command: The words that the operator typed, but for `--rebuild`.
        quantities: Names of what is drawn besides what is drawn in any case.
        unmeasured: Planned conditions without any attempt, in words.
    """
    evidence = at_hand(repeats)
    is_whole = evidence.plans.keys() == set(repeats.texts["source"].tolist())
    cells = sorted(aggregate(repeats), key=_order)
    identities = Identities(cells)
    row = repeat_to_draw(cells, evidence, repeat)
    ranking = Ranking(evidence)
    first = list(dict.fromkeys(plain_name(quantity.name) for quantity in ranking.first(measured_in(cells))))
    against_distance = [
        ChartSection(
            what.replace(" ", "-"),
            f"{what.capitalize()} against distance",
            [*distance.charts(cells, identities, evidence, names)],
        )
        for what, names in (
            (_FIRST, first),
            *((what, [name for name in names if name not in first]) for what, names in _SECTIONS),
        )
    ]
    against_distance.append(_further(cells, identities, evidence, quantities, first))
    sections = (
        ChartSection("quantities", "Quantities at one distance", list(dots.charts(cells, identities, evidence))),
        ChartSection("distributions", "Distributions", list(distribution.charts(cells, identities, evidence))),
        ChartSection("one-repeat", "One repeat", [] if row is None else list(timeline.charts(row, evidence))),
    )
    return Contents(
        title=title or summary.title(cells),
        paragraph=summary.paragraph(cells, evidence),
        headlines=list(headlines(cells, evidence, unmeasured)),
        warnings=list(summary.warnings(cells, evidence)),
        verdicts=expected.verdicts(cells, evidence),
        against_distance=[section for section in against_distance if section.charts],
        tables=_tables(cells, evidence),
        sections=[section for section in sections if section.charts],
        strips=list(strips.groups(cells, identities, evidence)),
        bursts=list(bursts.groups(cells, evidence)),
        trials=list(provenance.trials(evidence)),
        evidence=evidence,
        command=shlex.join([*command, "--rebuild"] if is_whole else command),
    )


def _further(
    cells: Sequence[Cell],
    identities: Identities,
    evidence: Evidence,
    wanted: Sequence[str],
    first: Sequence[str],
) -> ChartSection:
    """Return curves of what is not fieldkit's own, as many as can be looked at, and of what is wanted besides.

    Args:
        cells: Conditions.
        identities: Looks of their series.
        evidence: The table and what is at hand beside it.
        wanted: Names of quantities that are drawn in any case.
        first: Plain names of those that are drawn already.
    """
    drawn = {*distance.LOSS, *distance.DELAY, *distance.RATE, *first}
    others: dict[str, str] = {}  # by plain name the first of that
    for one in measured_in(cells):
        if not one.is_own and plain_name(one.name) not in drawn and distance.has_curve(cells, one, evidence):
            others.setdefault(plain_name(one.name), one.name)
    chosen = dict.fromkeys((*map(plain_name, wanted), *list(others)[:_MOST_FURTHER]))
    left = [name for plain, name in others.items() if plain not in chosen]
    return ChartSection(
        "further",
        "Further figures against distance",
        [*distance.charts(cells, identities, evidence, [name for name in chosen if name not in drawn])],
        f"Not drawn: {', '.join(left)}. To draw one: --quantity {left[0]}." if left else "",
    )


def repeat_to_draw(cells: Sequence[Cell], evidence: Evidence, wanted: str) -> int | None:
    """Return the row whose time line is drawn.

    Args:
        cells: Conditions.
        evidence: The table and what is at hand beside it.
        wanted: Folder of an attempt, `udp-07`, with `TRIAL/` before it where several trials have one; empty for the
            one with the median loss, among valid repeats that lost anything under the condition that loses most.

    Returns:
        None when nothing was wanted and no evidence is at hand.

    Raises:
        ConfigurationError: There is no such attempt, or several, or its evidence is not at hand.
    """
    if wanted:
        row = evidence.repeats.row(wanted)
        if evidence.attempt(row) is None:
            raise ConfigurationError(
                f"the evidence of {wanted} is not at hand", remedy="name a repeat of a trial whose folder is"
            )
        return row
    measured = measured_in(cells)
    names = [(one.name, 0.0) for name in LOSSES for one in alike(measured, name)]
    names += [(one.name, -np.inf) for name in ("transfer_s", "rtt_median_s") for one in alike(measured, name)]
    for name, least in names:
        having = [cell for cell in cells if name in cell.estimates]
        for cell in sorted(having, key=lambda one: one.estimates[name].value, reverse=True):
            values, rows = evidence.repeats.numbers[name], evidence.valid(cell, name)
            shown = [row for row in rows[values[rows] > least].tolist() if evidence.attempt(row)]
            if shown:
                return int(sorted(shown, key=lambda row: values[row])[(len(shown) - 1) // 2])
    return None


def _order(cell: Cell) -> tuple[str | float, ...]:
    names = ("protocol", "topology", "scenario", "procedure")
    return *(wording.text(cell, name) for name in names), wording.metres(cell), wording.text(cell, "backend")


def _tables(cells: Sequence[Cell], evidence: Evidence) -> list[CellTable]:
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(wording.text(cell, "protocol").upper(), []).append(cell)
    told = wording.differing(cells)
    ranking = Ranking(evidence)
    return [
        replace(table, missing=_reasons(table, evidence))
        for title, group in groups.items()
        for table in _tables_of(title, group, told, evidence, ranking)
    ]


def _reasons(table: CellTable, evidence: Evidence) -> dict[tuple[int, str], str]:
    """Return why conditions of a table have no figure."""
    cells = [cell for _, cell in table.lines]
    numbers = {id(cell): number for number, cell in enumerate(cells)}
    return {
        (numbers[id(absence.cell)], quantity.name): absence.text
        for quantity in (*table.quantities, *table.more)
        for absence in absences(cells, quantity, evidence)
        if absence.is_total
    }


def _tables_of(
    title: str, cells: Sequence[Cell], told: Collection[str], evidence: Evidence, ranking: Ranking
) -> Iterator[CellTable]:
    """Yield the tables of one protocol: expected quantities and the lab's own, fieldkit's, those of steps, words."""
    lines = [(wording.place(cell, told=told), cell) for cell in cells]
    words = worded(cells)
    first = ranking.first(measured_in(cells))
    if own_words := {name: said for name, said in words.items() if ranking.is_own(name)}:
        words = {name: said for name, said in words.items() if name not in own_words}
    if first or own_words:
        yield CellTable(f"{title}, {_FIRST}", first, (), lines, _sizes(first, cells, evidence), own_words)
    known = [quantity for quantity in measured_in(cells) if quantity not in first]
    for step in dict.fromkeys(("", *(one.step for one in known))):
        own = [one for one in known if one.step == step and one.is_own]
        other = [one for one in known if one.step == step and not one.is_own]
        # Where nothing is quoted the others are all that there is.
        quoted = [one for one in own if plain_name(one.name) in _QUOTED] or own[:_MOST_IN_TABLE]
        more = [one for one in own if one not in quoted]
        if own or (not step and not known and not first):
            yield CellTable(
                ", ".join(filter(None, (title, step))), quoted, more, lines, _sizes(quoted, cells, evidence)
            )
        if other:
            said = ", ".join(filter(None, (title, step, "further figures")))
            yield CellTable(said, other[:_MOST_IN_TABLE], other[_MOST_IN_TABLE:], lines, {})
    if words:
        yield CellTable(f"{title}, words", (), (), lines, {}, words)


def _sizes(quantities: Sequence[Quantity], cells: Sequence[Cell], evidence: Evidence) -> dict[str, str]:
    """Return how large the requests were of pings whose round-trip time is among some quantities, by its name."""
    return {
        quantity.name: ", ".join(evidence.payloads(cells, quantity.step))
        for quantity in quantities
        if plain_name(quantity.name) == "rtt_median_s"
    }
