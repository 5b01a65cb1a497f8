"""Panels of conditions, and the colour, shape and line that each series keeps throughout a report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count

from fieldkit.analysis.cells import Cell
from fieldkit.core.model import Scenario
from fieldkit.report import wording
from fieldkit.report.theme import CYCLE, LINES, Style

_SCENARIOS = [str(one) for one in Scenario]


@dataclass(frozen=True)
class Identity:
    """How a series is called and drawn.

    Attributes:
        label: `LOS`; with the procedure where several have the scenario, and the backend where there are several.
        style: Its look.
        rank: Its place among the others: by scenario, in each the field first.
    """

    label: str
    style: Style
    rank: tuple[int, int]


class Identities:
    """The identity of the series that each cell belongs to: procedure and scenario by colour, backend by line.

    Args:
        cells: All that stand in the report, so that each has the same looks in every figure.
    """

    def __init__(self, cells: Sequence[Cell]) -> None:
        kinds = sorted({_kind(cell) for cell in cells}, key=_by_scenario)
        backends = sorted({wording.text(cell, "backend") for cell in cells}, key=lambda name: (name != "field", name))
        # The first of line of sight and the first without it keep their looks, also where the other is missing.
        kept, others = {str(one): rank for rank, one in enumerate(Scenario)}, count(len(Scenario))
        self._kinds = {kind: kept.pop(kind[0]) if kind[0] in kept else next(others) for kind in kinds}
        self._backends = {name: index for index, name in enumerate(backends)}
        self._ambiguous = len({scenario for scenario, _ in kinds}) < len(kinds)

    def of(self, cell: Cell) -> Identity:
        """Return the identity of the series of `cell`."""
        backend = wording.text(cell, "backend")
        parts = (
            wording.scenario(cell),
            wording.procedure(cell) if self._ambiguous else "",
            backend if len(self._backends) > 1 else "",
        )
        rank = self._kinds[_kind(cell)], self._backends[backend]
        style = Style(*CYCLE[rank[0] % len(CYCLE)], LINES[rank[1] % len(LINES)])
        return Identity(", ".join(filter(None, parts)), style, rank)


def panels(cells: Sequence[Cell]) -> Mapping[str, Sequence[Cell]]:
    """Return cells by the title of the panel in which they stand, one per protocol and topology: `UDP, master`."""
    found: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        found.setdefault((wording.text(cell, "protocol"), wording.text(cell, "topology")), []).append(cell)
    return {
        ", ".join(filter(None, (protocol.upper(), topology))) or "all": group
        for (protocol, topology), group in sorted(found.items())
    }


def _kind(cell: Cell) -> tuple[str, str]:
    return wording.text(cell, "scenario"), wording.text(cell, "procedure")


def _by_scenario(kind: tuple[str, str]) -> tuple[bool, int, str, str]:
    """Return what kinds are sorted by: first the plain ones, of which the scenario is the procedure's name."""
    scenario, procedure = kind
    known = _SCENARIOS.index(scenario) if scenario in _SCENARIOS else len(_SCENARIOS)
    return scenario != procedure, known, scenario, procedure
