"""Cells as tables in CSV, JSON, Markdown and LaTeX."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import groupby
from typing import Any, Final

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.table_lines import TableLine, lines
from fieldkit.core.columns import SCHEMA_VERSION, Kind, csv_text
from fieldkit.core.result_rows import EstimateRow, declared
from fieldkit.core.text import json_text, one_line

MORE: Final = "more_wanted"
_MARKUP: Final = re.compile(r"[\\|`*]|<(?=[A-Za-z/!?])|(?<=\])[(\[:]")
_ACROSS_COLUMNS: Final = ("scenario", "protocol")
_LATEX_AT_LEAST: Final = r"$\geq$ "
_LATEX_SPECIAL: Final = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{char: f"\\{char}" for char in "&%$#_{}"},
}


def estimate_rows(cell: Cell) -> Iterator[EstimateRow]:
    """Yield the table rows of a cell: one per quantity and word, or a single row if it has none."""
    counts: dict[str, Any] = {"n_valid": cell.n_valid, "n_void": cell.n_void, "n_failed": cell.n_failed}
    if not cell.estimates and not cell.tallies:
        yield EstimateRow(**counts)
    for name, estimate in cell.estimates.items():
        values = {item.name: getattr(estimate, item.name, None) for item in fields(EstimateRow)}
        yield EstimateRow(
            **{
                **values,
                **counts,
                "quantity": name,
                "unit": estimate.quantity.unit,
                "estimate": estimate.quantity.kind,
            }
        )
    for tally in cell.tallies.values():
        for word, events in tally.counts.items():
            yield EstimateRow(
                quantity=tally.quantity(word),
                unit="share",
                **counts,
                n=tally.n,
                value=tally.share(word),
                estimate=Kind.WORDS,
                events=events,
                trials=tally.n,
            )


def to_csv(by: Sequence[str], cells: Sequence[Cell], more: Sequence[Mapping[str, int]] = ()) -> str:
    """Return cells as CSV: the columns `by` that identify them, then those of `EstimateRow`.

    Args:
        by: Columns that identify cells.
        cells: The cells.
        more: Number of additional repeats by quantity, for each cell; they are the last column, if given.
    """
    names = [column.name for column in declared(EstimateRow)]
    additional = more or ({},) * len(cells)
    rows = (
        [*(cell.key[name] for name in by), *(getattr(row, name) for name in names)]
        + ([counts.get(row.quantity or "")] if more else [])
        for cell, counts in zip(cells, additional, strict=True)
        for row in estimate_rows(cell)
    )
    return csv_text([*by, *names, *([MORE] if more else [])], rows)


def to_json(by: Sequence[str], cells: Sequence[Cell], more: Sequence[Mapping[str, int]] = ()) -> str:
    """Return cells as one JSON object with the names, units and digits of `to_csv`; missing values are null."""
    additional = more or ({},) * len(cells)
    listed = [_cell_object(cell, counts if more else None) for cell, counts in zip(cells, additional, strict=True)]
    cautions = list(wording.cautions(cells))
    document = {"schema_version": SCHEMA_VERSION, "by": list(by), "cautions": cautions, "cells": listed}
    return json_text(document, indent=1, allow_nan=False) + "\n"


def _cell_object(cell: Cell, more: Mapping[str, int] | None) -> dict[str, Any]:
    counts = ("n_valid", "n_void", "n_failed")
    estimates = {}
    for row in estimate_rows(cell):
        if row.quantity is not None:
            values = {name: rounded(value) for name, value in asdict(row).items()}
            additional = {} if more is None else {MORE: more.get(row.quantity)}
            estimates[values.pop("quantity")] = {
                name: value for name, value in (values | additional).items() if name not in counts
            }
    return {"key": dict(cell.key), **{name: getattr(cell, name) for name in counts}, "estimates": estimates}


def rounded(value: object) -> Any:  # noqa: ANN401 (any JSON value)
    """Return a number rounded to the digits of a CSV."""
    return float(f"{value:.9g}") if isinstance(value, float) else value


def to_markdown(by: Sequence[str], cells: Sequence[Cell], quantities: Sequence[Quantity]) -> str:
    """Return a Markdown table of the estimates with their intervals, followed by word counts.

    The values that all cells have in common are in a line above the table.
    """
    varying, common = wording.varying_and_common(by, cells)
    shown = [(line, line.scale(cells)) for line in lines(cells, quantities)]
    words = wording.word_labels(cells)
    head = [*varying, "repeats", *(scale.head(line.label) for line, scale in shown), *words.values()]
    marks = ["---"] * (len(varying) + 1) + ["---:"] * len(shown) + ["---"] * len(words)
    rows = [markdown_line(head), markdown_line(marks)]
    for cell in cells:
        conditions = (wording.key(cell, name) for name in varying)
        figures = (line.number(cell, scale) for line, scale in shown)
        tallies = (wording.tally(cell, name) for name in words)
        rows.append(markdown_line([*conditions, wording.counts(cell), *figures, *tallies]))
    values = markdown_escaped(", ".join(f"{name} {wording.key(cells[0], name)}" for name in common))
    above = f"{values}; each value with its 95 % interval" if values else "Each value with its 95 % interval"
    below = "".join(f"\n{markdown_escaped(caution)}.\n" for caution in wording.cautions(cells))
    return f"{above}.\n\n" + "".join(rows) + below


def markdown_line(parts: Iterable[str]) -> str:
    """Return a line of a Markdown table."""
    return f"| {' | '.join(map(markdown_escaped, parts))} |\n"


def markdown_escaped(text: str) -> str:
    """Return an untrusted text escaped for a table cell, so that it is not markup, a link or HTML."""
    return _MARKUP.sub(r"\\\g<0>", one_line(text))


@dataclass(frozen=True)
class _Column:
    """One column of figures; its head has one line per attribute, empty if the cells do not differ in it."""

    scenario: str
    line: TableLine
    protocol: str

    def has(self, cell: Cell) -> bool:
        has_figure = self.line.estimate(cell) is not None or self.line.is_lacking(cell)
        return has_figure and (self.scenario, self.protocol) == _scenario_and_protocol(cell)


def to_latex(by: Sequence[str], cells: Sequence[Cell], quantities: Sequence[Quantity]) -> str:
    """Return a LaTeX `table` of column width (needs booktabs and graphicx); columns without a figure are omitted."""
    row_keys, common = (
        [name for name in names if name not in _ACROSS_COLUMNS] for names in wording.varying_and_common(by, cells)
    )
    scales = {line: line.scale(cells) for line in lines(cells, quantities)}
    scenarios, protocols = (dict.fromkeys(values) for values in zip(*map(_scenario_and_protocol, cells), strict=True))
    columns = [
        column
        for column in (
            _Column(scenario, line, other) for scenario in scenarios for line in scales for other in protocols
        )
        if any(column.has(cell) for cell in cells)
    ]
    rows: dict[tuple[str, ...], list[Cell]] = {}
    for cell in cells:
        rows.setdefault(tuple(wording.key(cell, name) for name in row_keys), []).append(cell)
    parts = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{_latex_caption(common, cells)}}}",
        r"\resizebox{\columnwidth}{!}{%",
        rf"\begin{{tabular}}{{{'l' * len(row_keys)}{'r' * len(columns)}}}",
        r"\toprule",
        *_latex_head(row_keys, columns, scales),
        r"\midrule",
        *(
            _latex_line([*map(_latex_escaped, key), *_latex_figures(columns, scales, row)])
            for key, row in rows.items()
        ),
        r"\bottomrule",
        r"\end{tabular}}",
        r"\end{table}",
    ]
    return "\n".join(parts) + "\n"


def _scenario_and_protocol(cell: Cell) -> tuple[str, str]:
    scenario, protocol = (wording.key(cell, name).upper() if name in cell.key else "" for name in _ACROSS_COLUMNS)
    return scenario, protocol


def _latex_caption(common: Sequence[str], cells: Sequence[Cell]) -> str:
    counts = sorted({cell.n_valid for cell in cells})
    n = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    above = "".join(f"{name} {wording.key(cells[0], name)}, " for name in common)
    below = "".join(f" {caution}." for caution in wording.cautions(cells))
    return _latex_escaped(f"{above}{n} valid repeats each; in brackets 95 % intervals.{below}")


def _latex_head(
    row_keys: Sequence[str], columns: Sequence[_Column], scales: Mapping[TableLine, wording.Scale]
) -> Iterator[str]:
    """Yield the lines of the head; a cell over several columns has a rule below it."""
    labels = [scales[column.line].head(column.line.label) for column in columns]
    levels: list[list[tuple[str, ...]]] = [
        [(column.scenario,) for column in columns],
        [(column.scenario, label) for column, label in zip(columns, labels, strict=True)],
        [(column.scenario, label, column.protocol) for column, label in zip(columns, labels, strict=True)],
    ]
    levels = [level for level in levels if any(path[-1] for path in level)]
    for level in levels:
        is_last = level is levels[-1]
        parts, rules, first = [], [], len(row_keys) + 1
        for path, group in groupby(level):
            width = len(list(group))
            parts.append(rf"\multicolumn{{{width}}}{{c}}{{{_latex_escaped(path[-1])}}}")
            rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}")
            first += width
        yield _latex_line([*(_latex_escaped(name) if is_last else "" for name in row_keys), *parts])
        if not is_last:
            yield " ".join(rules)


def _latex_figures(
    columns: Sequence[_Column], scales: Mapping[TableLine, wording.Scale], row: Sequence[Cell]
) -> Iterator[str]:
    for column in columns:
        figures = " ".join(column.line.number(cell, scales[column.line]) for cell in row if column.has(cell))
        yield _latex_escaped(figures).replace(">= ", _LATEX_AT_LEAST)


def _latex_line(parts: Sequence[str]) -> str:
    return " & ".join(parts) + r" \\"


def _latex_escaped(text: str) -> str:
    return "".join(_LATEX_SPECIAL.get(char, char) for char in one_line(text))
