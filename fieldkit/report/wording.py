"""Numbers, conditions and quantities as text, the same in the summary, in tables and below figures.

A cell contains the repeats under one condition, and their estimates.
"""

import re
from collections.abc import Collection, Sequence
from typing import Final

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.wording import Scale, amount, incomplete, scale_of
from fieldkit.analysis.wording import interval as interval_of


def value(result: Estimate) -> str:
    """Return the value of an estimate with non-breaking spaces: `3.21 %`."""
    return without_breaks(amount(_scale(result), result))


def interval(result: Estimate) -> str:
    """Return the interval of an estimate, `[1.10, 6.70] (7 of 10)` if only 7 of 10 repeats have a value, or empty."""
    part = incomplete(result)
    return without_breaks(" ".join(filter(None, (interval_of(_scale(result), result), f"({part})" if part else ""))))


def estimate(result: Estimate) -> str:
    """Return the value of an estimate with its interval: `3.21 % [1.10, 6.70]`."""
    return f"{value(result)} {interval(result)}".strip()


def without_breaks(words: str) -> str:
    """Return a text with each space replaced by a non-breaking space."""
    return words.replace(" ", "\N{NO-BREAK SPACE}")


def _scale(result: Estimate) -> Scale:
    return scale_of(result.quantity, [result.value])


def text(cell: Cell, name: str) -> str:
    """Return a text of a cell's key, or an empty string if it is missing."""
    return str(cell.key[name] or "")


def group(cell: Cell) -> tuple[str, str]:
    """Return protocol and topology of a cell, or empty strings if they are missing."""
    return text(cell, "protocol"), text(cell, "topology")


def metres(cell: Cell) -> float:
    """Return a cell's distance in metres, or 0 if it is missing."""
    value_m = cell.key["distance_m"]
    return value_m if isinstance(value_m, float) else 0.0


def distance(cell: Cell) -> str:
    """Return a cell's distance as the operator wrote it, `30ft`, or in metres if that text is missing."""
    if label := text(cell, "distance"):
        return label
    return "distance unknown" if cell.key["distance_m"] is None else without_breaks(f"{metres(cell):.2f} m")


def scenario(cell: Cell) -> str:
    """Return a cell's scenario, `LOS` or `NLOS`; without one its procedure, and without both `no scenario`."""
    return text(cell, "scenario").upper() or text(cell, "procedure") or "no scenario"


def procedure(cell: Cell) -> str:
    """Return the name of a cell's procedure, or an empty string if there is no scenario or it has the same name."""
    name, scenario_name = text(cell, "procedure"), text(cell, "scenario")
    return name if scenario_name and name != scenario_name else ""


def place(cell: Cell, *, differing: Collection[str]) -> str:
    """Return the part of a cell's condition in which cells differ: `LOS, master, 30ft, field`.

    Args:
        cell: The cell.
        differing: Columns of its key that differ between the cells; other parts are omitted, except for the distance.
    """
    parts = {
        "scenario": scenario(cell),
        "procedure": procedure(cell) if "scenario" in differing else text(cell, "procedure"),
        "topology": text(cell, "topology"),
        "distance_m": distance(cell),
        "backend": text(cell, "backend"),
    }
    return ", ".join(part for name, part in parts.items() if part and (name in differing or name == "distance_m"))


def condition(cell: Cell, *, differing: Collection[str]) -> str:
    """Return the condition of a cell with its protocol: `UDP, 30ft`."""
    return ", ".join(filter(None, (text(cell, "protocol").upper(), place(cell, differing=differing))))


def differing(cells: Sequence[Cell]) -> frozenset[str]:
    """Return the columns whose values differ between cells; `procedure` is omitted if the scenario determines it."""
    names = {name for name in cells[0].key if len({cell.key[name] for cell in cells}) > 1} if cells else set()
    kinds = {(cell.key["scenario"], cell.key["procedure"]) for cell in cells}
    if len(kinds) == len({scenario for scenario, _ in kinds}):
        names -= {"procedure"}
    return frozenset(names)


def natural_sort_key(name: str) -> tuple[str | float, ...]:
    """Return a sort key that orders numbers in texts by their value: `loss 2%` is before `loss 10%`."""
    return tuple(
        float(part) if index % 2 else part for index, part in enumerate(re.split(r"([0-9]+(?:\.[0-9]+)?)", name))
    )


def join_words(parts: list[str]) -> str:
    """Return `a`, `a and b`, or `a, b and c`."""
    return " and ".join(filter(None, (", ".join(parts[:-1]), *parts[-1:])))


_MAX_NAMES: Final = 4


def join_names(names: list[str]) -> str:
    """Return names joined like `join_words`.

    If there are more than four, the result has the first two and the number of others.
    """
    if len(names) > _MAX_NAMES:
        names = [*names[:2], f"{len(names) - 2} others"]
    return join_words(names)
