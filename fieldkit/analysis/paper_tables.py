"""Tables of cells (the repeats under one condition, and their estimates) for readers, in Markdown and LaTeX."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.table_lines import TableLine, lines
from fieldkit.core.text import one_line

_MARKUP: Final = re.compile(r"[\\|`*]|<(?=[A-Za-z/!?])|(?<=\])[(\[:]")
"""Characters that Markdown would interpret in a table cell."""
_ACROSS_COLUMNS: Final = ("scenario", "protocol")
"""Conditions whose values are heads of columns in a LaTeX table. The values of other conditions identify rows."""
_LATEX_AT_LEAST: Final = r"$\geq$ "
_LATEX_SPECIAL: Final = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{char: f"\\{char}" for char in "&%$#_{}"},
}


def to_markdown(by: Sequence[str], cells: Sequence[Cell], quantities: Sequence[Quantity]) -> str:
    """Return a Markdown table of the estimates with their intervals, followed by the counts of text values.

    Values that are equal in all cells are in a line above the table.
    """
    varying, common = wording.varying_and_common(by, cells)
    shown = [(line, line.scale(cells)) for line in lines(cells, quantities)]
    words = wording.word_labels(cells)
    head = [*varying, "repeats", *(scale.head(line.label) for line, scale in shown), *words.values()]
    alignments = ["---"] * (len(varying) + 1) + ["---:"] * len(shown) + ["---"] * len(words)
    rows = [markdown_line(head), markdown_line(alignments)]
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
    """Return an untrusted text, escaped for a table cell so that it is not interpreted as markup, a link or HTML."""
    return _MARKUP.sub(r"\\\g<0>", one_line(text))


@dataclass(frozen=True)
class _Column:
    """One column of figures. Its head has one line per attribute, which is empty if all cells have the same value."""

    scenario: str
    line: TableLine
    protocol: str

    def has(self, cell: Cell) -> bool:
        has_figure = self.line.estimate(cell) is not None or self.line.lacks_value(cell)
        return has_figure and (self.scenario, self.protocol) == _scenario_and_protocol(cell)


def to_latex(by: Sequence[str], cells: Sequence[Cell], quantities: Sequence[Quantity]) -> str:
    """Return a LaTeX `table` of column width (needs booktabs and graphicx). Columns without figures are omitted."""
    row_keys, common = (
        [name for name in names if name not in _ACROSS_COLUMNS] for names in wording.varying_and_common(by, cells)
    )
    scales = {line: line.scale(cells) for line in lines(cells, quantities)}
    scenarios, protocols = (dict.fromkeys(values) for values in zip(*map(_scenario_and_protocol, cells), strict=True))
    columns = [
        column
        for column in (
            _Column(scenario, line, protocol) for scenario in scenarios for line in scales for protocol in protocols
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
    """Yield the lines of the table's head. A cell over several columns has a rule below it."""
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
