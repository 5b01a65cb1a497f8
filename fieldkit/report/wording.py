"""Numbers, conditions and quantities in words, the same in the summary, in tables and below figures."""

from collections.abc import Collection, Sequence

from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.wording import Scale, amount, incomplete, scale_of
from fieldkit.analysis.wording import interval as interval_of


def value(found: Estimate) -> str:
    """Return the figure to quote, unbroken: `3.21 %`."""
    return unbroken(amount(_scale(found), found))


def interval(found: Estimate) -> str:
    """Return its interval, unbroken, and of how many repeats it is if not of all: `[1.10, 6.70] (7 of 10)`."""
    of = incomplete(found)
    return unbroken(" ".join(filter(None, (interval_of(_scale(found), found), f"({of})" if of else ""))))


def estimate(found: Estimate) -> str:
    """Return the figure to quote with its interval: `3.21 % [1.10, 6.70]`."""
    return f"{value(found)} {interval(found)}".strip()


def unbroken(said: str) -> str:
    """Return words between which no line is broken."""
    return said.replace(" ", "\N{NO-BREAK SPACE}")


def _scale(found: Estimate) -> Scale:
    return scale_of(found.quantity, [found.value])


def text(cell: Cell, name: str) -> str:
    """Return a text of a cell's key, empty where missing."""
    return str(cell.key[name] or "")


def metres(cell: Cell) -> float:
    """Return a cell's distance in metres, 0 where it is missing."""
    found = cell.key["distance_m"]
    return found if isinstance(found, float) else 0.0


def distance(cell: Cell) -> str:
    """Return a cell's distance as its operator wrote it, `30ft`; in metres if only these are known."""
    if label := text(cell, "distance"):
        return label
    return "distance unknown" if cell.key["distance_m"] is None else unbroken(f"{metres(cell):.2f} m")


def scenario(cell: Cell) -> str:
    """Return a cell's scenario, `LOS` or `NLOS`; the procedure where there is none."""
    return text(cell, "scenario").upper() or text(cell, "procedure") or "no scenario"


def procedure(cell: Cell) -> str:
    """Return what a cell's procedure is called, empty where its scenario says so already."""
    name, scene = text(cell, "procedure"), text(cell, "scenario")
    return name if scene and name != scene else ""


def place(cell: Cell, *, told: Collection[str]) -> str:
    """Return what distinguishes a cell from others: `LOS, master, 30ft, field`.

    Args:
        cell: Which.
        told: Columns of its key that differ among those others; what does not is left out, but for the distance.
    """
    parts = {
        "scenario": scenario(cell),
        "procedure": procedure(cell) if "scenario" in told else text(cell, "procedure"),
        "topology": text(cell, "topology"),
        "distance_m": distance(cell),
        "backend": text(cell, "backend"),
    }
    return ", ".join(said for name, said in parts.items() if said and (name in told or name == "distance_m"))


def condition(cell: Cell, *, told: Collection[str]) -> str:
    """Return the same with the protocol before it: `UDP, 30ft`."""
    return ", ".join(filter(None, (text(cell, "protocol").upper(), place(cell, told=told))))


def differing(cells: Sequence[Cell]) -> frozenset[str]:
    """Return the columns of their keys that tell these cells apart; the scenario tells for its procedure."""
    names = {name for name in cells[0].key if len({cell.key[name] for cell in cells}) > 1} if cells else set()
    kinds = {(cell.key["scenario"], cell.key["procedure"]) for cell in cells}
    if len(kinds) == len({scenario for scenario, _ in kinds}):
        names -= {"procedure"}
    return frozenset(names)


def listed(parts: list[str]) -> str:
    """Return `a`, `a and b`, or `a, b and c`."""
    return " and ".join(filter(None, (", ".join(parts[:-1]), *parts[-1:])))
