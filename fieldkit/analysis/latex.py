"""Cells as a table for a paper: distances down; scenario, quantity and protocol across."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity

_ACROSS: Final = ("scenario", "protocol")
_SPECIAL: Final = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{char: f"\\{char}" for char in "&%$#_{}"},
}


@dataclass(frozen=True)
class _Column:
    """One column of figures; its head has a line for each of these, empty where cells are not told apart by it."""

    scenario: str
    quantity: Quantity
    protocol: str

    def has(self, cell: Cell) -> bool:
        return self.quantity.name in cell.estimates and (self.scenario, self.protocol) == _across(cell)


def to_latex(by: Sequence[str], cells: Sequence[Cell], quantities: Sequence[Quantity]) -> str:
    """Return a `table` as wide as a column; it needs booktabs and graphicx. Columns without a figure are left out."""
    down, common = ([name for name in names if name not in _ACROSS] for names in wording.told_by(by, cells))
    shown = wording.shown(cells, quantities)
    scenarios, protocols = (dict.fromkeys(values) for values in zip(*map(_across, cells), strict=True))
    columns = [
        column
        for column in (
            _Column(one, quantity, other) for one in scenarios for quantity in shown for other in protocols
        )
        if any(column.has(cell) for cell in cells)
    ]
    scales = {one: wording.scale(one, cells) for one in shown}
    rows: dict[tuple[str, ...], list[Cell]] = {}
    for cell in cells:
        rows.setdefault(tuple(wording.key(cell, name) for name in down), []).append(cell)
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{_caption(common, cells)}}}",
        r"\resizebox{\columnwidth}{!}{%",
        rf"\begin{{tabular}}{{{'l' * len(down)}{'r' * len(columns)}}}",
        r"\toprule",
        *_head(down, columns, scales),
        r"\midrule",
        *(_line([*map(_escaped, key), *_figures(columns, scales, row)]) for key, row in rows.items()),
        r"\bottomrule",
        r"\end{tabular}}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _across(cell: Cell) -> tuple[str, str]:
    scenario, protocol = (wording.key(cell, name).upper() if name in cell.key else "" for name in _ACROSS)
    return scenario, protocol


def _caption(common: Sequence[str], cells: Sequence[Cell]) -> str:
    counts = sorted({cell.n_valid for cell in cells})
    n = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    above = "".join(f"{name} {wording.key(cells[0], name)}, " for name in common)
    return _escaped(f"{above}{n} valid repeats each; in brackets 95 % intervals.")


def _head(down: Sequence[str], columns: Sequence[_Column], scales: dict[Quantity, wording.Scale]) -> Iterator[str]:
    """Yield the lines of the head: what stands over several columns is ruled off below."""
    named = [f"{wording.label(one.quantity)} ({scales[one.quantity].unit})" for one in columns]
    levels: list[list[tuple[str, ...]]] = [
        [(one.scenario,) for one in columns],
        [(one.scenario, name) for one, name in zip(columns, named, strict=True)],
        [(one.scenario, name, one.protocol) for one, name in zip(columns, named, strict=True)],
    ]
    levels = [level for level in levels if any(path[-1] for path in level)]
    for level in levels:
        is_last = level is levels[-1]
        parts, rules, at = [], [], len(down) + 1
        for path, group in groupby(level):
            width = len(list(group))
            parts.append(rf"\multicolumn{{{width}}}{{c}}{{{_escaped(path[-1])}}}")
            rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
            at += width
        yield _line([*(_escaped(name) if is_last else "" for name in down), *parts])
        if not is_last:
            yield " ".join(rules)


def _figures(columns: Sequence[_Column], scales: dict[Quantity, wording.Scale], row: Sequence[Cell]) -> Iterator[str]:
    for column in columns:
        scale = scales[column.quantity]
        found = (cell.estimates[column.quantity.name] for cell in row if column.has(cell))
        yield " ".join(f"{scale.number(one.value)} {scale.interval(one.low, one.high)}".rstrip() for one in found)


def _line(parts: Sequence[str]) -> str:
    return " & ".join(parts) + r" \\"


def _escaped(text: str) -> str:
    return "".join(_SPECIAL.get(char, char) for char in text)
