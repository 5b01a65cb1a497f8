"""Panels of conditions, and the colour, marker and line of each series in all figures of a report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count

from fieldkit.analysis.cells import Cell
from fieldkit.core.model import Scenario
from fieldkit.report import wording
from fieldkit.report.theme import CYCLE, LINES, Style

_SCENARIOS = [str(scenario) for scenario in Scenario]


@dataclass(frozen=True)
class Identity:
    """Label and style of a series.

    Attributes:
        label: `LOS`, with the procedure if several have this scenario, and the backend if there are several.
        style: Its style.
        rank: Sort key: by scenario, within it the field backend first.
    """

    label: str
    style: Style
    rank: tuple[int, int]


class Identities:
    """The identity of the series that each cell belongs to: procedure and scenario by colour, backend by line.

    Args:
        cells: All cells of the report, so that each has the same style in every figure.
    """

    def __init__(self, cells: Sequence[Cell]) -> None:
        kinds = sorted({_kind(cell) for cell in cells}, key=_by_scenario)
        backends = sorted({wording.text(cell, "backend") for cell in cells}, key=lambda name: (name != "field", name))
        # The first series with line of sight and the first without have fixed styles, even if the other is missing.
        fixed, others = {str(scenario): rank for rank, scenario in enumerate(Scenario)}, count(len(Scenario))
        self._kinds = {kind: fixed.pop(kind[0]) if kind[0] in fixed else next(others) for kind in kinds}
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
    """Return cells by the title of their panel, one per protocol and topology: `UDP, master`."""
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((wording.text(cell, "protocol"), wording.text(cell, "topology")), []).append(cell)
    return {
        ", ".join(filter(None, (protocol.upper(), topology))) or "all": group
        for (protocol, topology), group in sorted(groups.items())
    }


def _kind(cell: Cell) -> tuple[str, str]:
    return wording.text(cell, "scenario"), wording.text(cell, "procedure")


def _by_scenario(kind: tuple[str, str]) -> tuple[bool, int, str, str]:
    """Return the sort key of a kind: first kinds whose procedure is named after the scenario."""
    scenario, procedure = kind
    index = _SCENARIOS.index(scenario) if scenario in _SCENARIOS else len(_SCENARIOS)
    return scenario != procedure, index, scenario, procedure
