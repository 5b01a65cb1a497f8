"""Cells as a table for GitHub: a condition per line, a quantity per column."""

import re
from collections.abc import Iterable, Sequence
from typing import Final

from fieldkit.analysis import wording
from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity

_MARKUP: Final = re.compile(r"[\\|`*]|<(?=[A-Za-z/!?])|(?<=\])[(\[:]")


def to_markdown(by: Sequence[str], cells: Sequence[Cell], quantities: Sequence[Quantity]) -> str:
    """Return a table of the figures to quote, each with its interval; what all cells share stands above it."""
    apart, common = wording.told_by(by, cells)
    scales = {one: wording.scale(one, cells) for one in wording.shown(cells, quantities)}
    head = [*apart, "repeats", *(f"{wording.label(one)} ({scale.unit})" for one, scale in scales.items())]
    lines = [line(head), line(["---"] * (len(apart) + 1) + ["---:"] * len(scales))]
    for cell in cells:
        found = [(scale, cell.estimates.get(one.name)) for one, scale in scales.items()]
        figures = (f"{s.number(e.value)} {s.interval(e.low, e.high)}".rstrip() if e else "" for s, e in found)
        lines.append(line([*(wording.key(cell, name) for name in apart), wording.counts(cell), *figures]))
    above = escaped(", ".join(f"{name} {wording.key(cells[0], name)}" for name in common))
    said = f"{above}; each value with its 95 % interval" if above else "Each value with its 95 % interval"
    return f"{said}.\n\n" + "".join(lines)


def line(parts: Iterable[str]) -> str:
    """Return a line of a table."""
    return f"| {' | '.join(map(escaped, parts))} |\n"


def escaped(text: str) -> str:
    """Return a text, of whoever wrote the evidence, that neither ends a cell nor is markup, a link or HTML."""
    return _MARKUP.sub(r"\\\g<0>", " ".join(text.splitlines()))
