"""Contents of a report, made from a table of repeats and the evidence that belongs to it.

A cell contains the repeats under one condition, and their estimates.
"""

import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import LOSSES, with_plain_name
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.wording import measured as measured_in
from fieldkit.core.columns import plain_name
from fieldkit.core.errors import ConfigurationError
from fieldkit.report import (
    distance,
    distribution,
    dots,
    expected,
    heat_maps,
    packet_rasters,
    strips,
    summary,
    timeline,
    wording,
)
from fieldkit.report.cell_tables import FIRST, CellTable, cell_tables
from fieldkit.report.charts import Chart
from fieldkit.report.headlines import Headline, Ranking, headlines
from fieldkit.report.series import Identities
from fieldkit.report.theme import CYCLE
from fieldkit.report.trial_folders import Evidence, load_evidence

_SECTIONS: Final = (("loss", distance.LOSS), ("delay", distance.DELAY), ("rate", distance.RATE))
_MAX_FURTHER: Final = 12
"""Maximum number of charts of quantities that are not defined by fieldkit."""
MAX_TRIALS_IN_TABLE: Final = 200
"""Maximum number of trials in the table of their provenance."""
_CROWDED: Final = (
    "Figures with a line or a strip per setting are left out, because there are too many settings to distinguish. "
    "Choose fewer with --where."
)


@dataclass(frozen=True)
class ChartSection:
    """Charts under one heading.

    Attributes:
        name: Name in links.
        title: The heading.
        charts: At least one.
        note: Names of omitted quantities, and how to draw them.
    """

    name: str
    title: str
    charts: Sequence[Chart]
    note: str = ""


@dataclass(frozen=True)
class Contents:
    """The contents of a report.

    Attributes:
        title: Its title.
        paragraph: Description of the trials.
        headlines: The most important figures.
        warnings: Limitations that a reader must know before quoting a figure.
        judgements: Judgements by text of the expectation, one per condition.
        against_distance: Charts against distance.
        tables: Cells, a table per protocol.
        sections: Further charts.
        strips: Attempts in order of time.
        bursts: The packets of repeats whose captures are available.
        trials: Provenance of each trial.
        evidence: The table and the available evidence.
        command: The command that regenerates this report.
        export_command: The command that exports every attempt.
        max_trials: Maximum number of trials that are listed.
    """

    title: str
    paragraph: str
    headlines: Sequence[Headline]
    warnings: Sequence[summary.Caution]
    judgements: Mapping[str, Sequence[expected.JudgementRow]]
    against_distance: Sequence[ChartSection]
    tables: Sequence[CellTable]
    sections: Sequence[ChartSection]
    strips: Sequence[strips.StripGroup]
    bursts: Sequence[packet_rasters.RasterGroup]
    trials: Sequence[summary.Provenance]
    evidence: Evidence
    command: str
    export_command: str
    max_trials: int = MAX_TRIALS_IN_TABLE

    @property
    def charts(self) -> list[Chart]:
        """The charts of all sections."""
        return [chart for section in (*self.against_distance, *self.sections) for chart in section.charts]

    @property
    def versions(self) -> dict[str, int]:
        """Number of trials for each known set of versions."""
        return Counter(trial.versions for trial in self.trials if trial.versions)


def build_contents(
    repeats: Repeats,
    *,
    title: str,
    repeat: str,
    command: Sequence[str],
    paths: Sequence[str] = (),
    quantities: Sequence[str] = (),
    unmeasured: Sequence[str] = (),
    sweep: Mapping[str, str] | None = None,
) -> Contents:
    """Return the contents of a report on `repeats`.

    Args:
        repeats: Attempts, with the column `source`.
        title: Its title; empty for a generated one.
        repeat: Repeat for the time line, as the argument `requested` of `repeat_to_draw`.
        command: The words of the operator's command, without `--rebuild`.
        paths: The paths in this command.
        quantities: Names of quantities to draw in addition to the default ones.
        unmeasured: Planned conditions without any attempt, in words.
        sweep: If the repeats are runs of sweeps, the result of `datasets.condition`: columns of the flow and of the
            factors, each with the column that contains its values as the user typed them. None or empty for other
            repeats.

    Raises:
        ConfigurationError: For the same reasons as `repeat_to_draw`.
    """
    evidence = load_evidence(repeats, repeat)
    has_all_plans = evidence.plans.keys() == set(repeats.texts["source"].tolist())
    cells = sorted(aggregate(repeats), key=_sort_key)
    identities = Identities(cells)
    row = repeat_to_draw(cells, evidence, repeat)
    ranking = Ranking(evidence)
    first = list(
        dict.fromkeys(plain_name(quantity.name) for quantity in ranking.first_quantities(measured_in(cells)))
    )
    is_crowded = bool(sweep) and len({identities.of(cell).rank for cell in cells}) > len(CYCLE)
    against_distance: list[ChartSection] = []
    sections: list[ChartSection] = []
    if sweep:
        maps = list(heat_maps.charts(repeats, sweep, quantities, one_factor=is_crowded))
        against_distance.append(ChartSection("factors", "Figures over factors", maps, _CROWDED if is_crowded else ""))
    if not is_crowded:
        against_distance += _against_distance(cells, identities, evidence, first)
        against_distance.append(_further_charts(cells, identities, evidence, quantities, first))
        sections = [
            ChartSection("quantities", "Quantities at one distance", list(dots.charts(cells, identities, evidence))),
            ChartSection("distributions", "Distributions", list(distribution.charts(cells, identities, evidence))),
            ChartSection("one-repeat", "One repeat", [] if row is None else list(timeline.charts(row, evidence))),
        ]
    return Contents(
        title=title or summary.title(cells, sweep or {}),
        paragraph=summary.paragraph(cells, evidence, sweep or {}),
        headlines=list(headlines(cells, evidence, unmeasured)),
        warnings=list(summary.warnings(cells, evidence)),
        judgements=expected.judgement_rows(cells, evidence),
        against_distance=[section for section in against_distance if section.charts],
        tables=cell_tables(cells, evidence),
        sections=[section for section in sections if section.charts],
        strips=[] if is_crowded else list(strips.groups(cells, identities, evidence)),
        bursts=list(packet_rasters.groups(cells, evidence)),
        trials=list(summary.trial_provenance(evidence)),
        evidence=evidence,
        command=shlex.join([*command, "--rebuild"] if has_all_plans else command),
        export_command=shlex.join(("fieldkit", "export", *paths, "--format", "csv", "-o", "attempts.csv")),
    )


def _against_distance(
    cells: Sequence[Cell], identities: Identities, evidence: Evidence, first: Sequence[str]
) -> Iterator[ChartSection]:
    """Yield the charts of quantities that fieldkit defines; quantities with the plain names `first` come first."""
    for heading, names in (
        (FIRST, first),
        *((kind, [name for name in names if name not in first]) for kind, names in _SECTIONS),
    ):
        drawn_charts = list(distance.charts(cells, identities, evidence, names))
        yield ChartSection(heading.replace(" ", "-"), f"{heading.capitalize()} against distance", drawn_charts)


def _further_charts(
    cells: Sequence[Cell],
    identities: Identities,
    evidence: Evidence,
    requested: Sequence[str],
    first: Sequence[str],
) -> ChartSection:
    """Return charts of quantities that fieldkit does not define, up to a limit, and of requested quantities.

    Args:
        cells: Conditions.
        identities: Labels and styles of their series.
        evidence: The table and the available evidence.
        requested: Names of quantities that are always drawn.
        first: Plain names of quantities that are drawn already.
    """
    drawn_names = {*distance.LOSS, *distance.DELAY, *distance.RATE, *first}
    further_names: dict[str, str] = {}  # by plain name, the name of the first quantity
    for quantity in measured_in(cells):
        if (
            not quantity.is_builtin
            and plain_name(quantity.name) not in drawn_names
            and distance.has_curve(cells, quantity, evidence)
        ):
            further_names.setdefault(plain_name(quantity.name), quantity.name)
    selected_names = dict.fromkeys((*map(plain_name, requested), *list(further_names)[:_MAX_FURTHER]))
    undrawn_names = [name for plain, name in further_names.items() if plain not in selected_names]
    return ChartSection(
        "further",
        "Further figures against distance",
        [*distance.charts(cells, identities, evidence, [name for name in selected_names if name not in drawn_names])],
        f"Not drawn: {', '.join(undrawn_names)}. To draw one: --quantity {undrawn_names[0]}."
        if undrawn_names
        else "",
    )


def repeat_to_draw(cells: Sequence[Cell], evidence: Evidence, requested: str) -> int | None:
    """Return the row whose time line is drawn.

    Args:
        cells: Conditions.
        evidence: The table and the available evidence.
        requested: Folder of an attempt, `udp-07`, preceded by `TRIAL/` if several trials have it. If empty, a valid
            repeat with available evidence is chosen from the condition with the highest loss: among its repeats with
            a loss above 0, the one with the median loss. If there is none, the longest transfer time or, without
            transfers, the longest round-trip time is used in place of the loss.

    Returns:
        The row, or None if `requested` is empty and no repeat can be chosen.

    Raises:
        ConfigurationError: There is no such attempt, or several, or its evidence is not available.
    """
    if requested:
        row = evidence.repeats.row(requested)
        if evidence.attempt(row) is None:
            raise ConfigurationError(
                f"the evidence of {requested} is not available", remedy="name a repeat of a trial whose folder exists"
            )
        return row
    measured = measured_in(cells)
    names = [(quantity.name, 0.0) for name in LOSSES for quantity in with_plain_name(measured, name)]
    names += [
        (quantity.name, -np.inf)
        for name in ("transfer_s", "rtt_median_s")
        for quantity in with_plain_name(measured, name)
    ]
    for name, minimum in names:
        measured_cells = [cell for cell in cells if name in cell.estimates]
        for cell in sorted(measured_cells, key=lambda cell: cell.estimates[name].value, reverse=True):
            values, rows = evidence.repeats.numbers[name], evidence.valid_rows(cell, name)
            candidates = [row for row in rows[values[rows] > minimum].tolist() if evidence.attempt(row)]
            if candidates:
                return int(sorted(candidates, key=lambda row: values[row])[(len(candidates) - 1) // 2])
    return None


def _sort_key(cell: Cell) -> tuple[object, ...]:
    names = ("protocol", "topology", "scenario")
    procedure = wording.natural_sort_key(wording.text(cell, "procedure"))
    return (
        *(wording.text(cell, name) for name in names),
        procedure,
        wording.metres(cell),
        wording.text(cell, "backend"),
    )
