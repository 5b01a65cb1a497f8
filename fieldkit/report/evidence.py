"""The folders behind the rows of a table, where they are at hand: plan, raw files, what is linked."""

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.parsing import Numbers
from fieldkit.analysis.quantities import DEFAULT_BY, Quantity
from fieldkit.analysis.repeats import Key, Repeats
from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import Status
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.evidence import ping
from fieldkit.trial import manifest, store
from fieldkit.trial.plan import PLAN_FILE, Plan


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is at hand beside a table of repeats.

    Attributes:
        repeats: The table.
        plans: Plan by the `source` of its rows; only sources that are folders of trials have one.
        unread: A sentence per plan that could not be read, and per trial whose evidence is not as it was kept.
        changed: The folders of attempts whose evidence is not; it is taken as not at hand.
    """

    repeats: Repeats
    plans: Mapping[str, Plan]
    unread: tuple[str, ...]
    changed: frozenset[Path]

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """What figures can be made of, by name and in order."""
        return {one.name: one for one in self.repeats.quantities}

    @cached_property
    def _rows(self) -> Mapping[Key, NDArray[np.int64]]:
        started_ns = self.repeats.numbers["started_utc_ns"]
        groups = self.repeats.groups(DEFAULT_BY)
        return {key: rows[np.argsort(started_ns[rows], kind="stable")] for key, rows in groups.items()}

    def rows(self, cell: Cell) -> NDArray[np.int64]:
        """Return the rows of a cell's attempts in order of time."""
        return self._rows[tuple(cell.key[name] for name in DEFAULT_BY)]

    def declared(self, cell: Cell) -> Set[str] | None:
        """Return the columns that the steps of a cell's trials measure, None if no plan of them is at hand."""
        key = tuple(cell.key[name] for name in DEFAULT_BY)
        if key not in self._declared:
            sources = dict.fromkeys(self.repeats.texts["source"][self.rows(cell)].tolist())
            plans = [self.plans[source] for source in sources if source in self.plans]
            steps = (placed.step for plan in plans for placed in plan.procedure.walk())
            names = frozenset(column.name for step in steps for column in step.output_columns())
            self._declared[key] = names if plans else None
        return self._declared[key]

    @cached_property
    def _declared(self) -> dict[Key, Set[str] | None]:
        return {}

    def valid(self, cell: Cell, name: str) -> NDArray[np.int64]:
        """Return the rows of a cell's valid repeats that have the column `name`, in order of time."""
        rows = self.rows(cell)
        is_valid = self.repeats.texts["status"][rows] == Status.VALID
        chosen: NDArray[np.int64] = rows[is_valid & np.isfinite(self.repeats.numbers[name][rows])]
        return chosen

    def observed(self, cell: Cell, quantity: Quantity) -> tuple[Numbers, NDArray[np.bool_]]:
        """Return the values of a cell's valid repeats in order of time, and which of them are only lower bounds."""
        rows = self.rows(cell)
        rows = rows[self.repeats.texts["status"][rows] == Status.VALID]
        values, is_bound = (column[rows] for column in self.repeats.observed(quantity))
        is_known = np.isfinite(values)
        return values[is_known], is_bound[is_known]

    def by_payload(self, cells: Sequence[Cell], step: str = "") -> Mapping[str, list[Cell]]:
        """Return cells by the size of their echo requests in words: those of different sizes are not compared."""
        found: dict[str, list[Cell]] = {}
        for cell in cells:
            found.setdefault(self.payload(cell, step), []).append(cell)
        return found

    def payloads(self, cells: Iterable[Cell], step: str = "") -> list[str]:
        """Return how large the echo requests of cells were, in words: `502 bytes`; of a step that has a name."""
        return [size for size in dict.fromkeys(self.payload(cell, step) for cell in cells) if size]

    def payload(self, cell: Cell, step: str = "") -> str:
        """Return how large a cell's echo requests were, in words: `502 bytes`; empty where nobody says."""
        name = f"{step}.rtt_payload_bytes".removeprefix(".")
        if name not in self.repeats.numbers:
            return ""
        sizes = np.unique(self.repeats.numbers[name][self.valid(cell, name)])
        return f"{' or '.join(f'{size:.0f}' for size in sizes)} bytes" if len(sizes) else ""

    def plan(self, row: int) -> Plan | None:
        """Return the plan of a row's trial, None where it is not at hand."""
        return self.plans.get(self.repeats.texts["source"][row])

    def attempt(self, row: int) -> AttemptEvidence | None:
        """Return a row's raw evidence, None where it is not at hand."""
        plan, texts, name = self.plan(row), self.repeats.texts, self.repeats.folder(row)
        if plan is None or name is None or plan.trial != texts["trial"][row]:
            return None
        folder = store.attempt_folder(Path(texts["source"][row]), name)
        return AttemptEvidence(folder) if folder.is_dir() and folder not in self.changed else None

    def pings(self, row: int, step: str = "") -> ping.Ping | None:
        """Return what ping said in a row's attempt, in a step that has a name; None where that is not at hand."""
        evidence, plan = self.attempt(row), self.plan(row)
        pinging = next((one for one in plan.pingings() if one.name == step), None) if plan else None
        return evidence.read_or_none(ping.read, pinging.file) if evidence and pinging else None


def at_hand(repeats: Repeats) -> Evidence:
    """Return what the sources of `repeats` hold beside their tables."""
    plans, unread, changed = {}, [], set[Path]()
    for source in dict.fromkeys(repeats.texts["source"].tolist()):
        if not (Path(source) / PLAN_FILE).is_file():
            continue
        try:
            plans[source] = store.read_plan(Path(source))
            if found := manifest.differences(Path(source)):
                unread.append(f"{source}: not as it was kept, evidence of which is left out: {manifest.few(found)}")
                changed |= {Path(source, *Path(name).parts[:2]) for name in found}
        except FieldkitError as error:
            unread.append(error.located)
    return Evidence(repeats, MappingProxyType(plans), tuple(unread), frozenset(changed))
