"""Plans and raw evidence of the trials in a table, which are read from the trials' folders if these are available.

A cell contains the repeats under one condition, and their estimates.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Final

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
from fieldkit.trial import planned_evidence, store
from fieldkit.trial.columns import columns_of_step
from fieldkit.trial.plan import PLAN_FILE, Plan
from fieldkit.trial.stored import plans as stored_plans
from fieldkit.trial.stored import verification

MAX_TRIALS: Final = 300
"""Maximum number of trials whose evidence is compared with the manifest and shown."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """A table of repeats with the available evidence.

    Attributes:
        repeats: The table.
        plans: Plans by the `source` of rows; only sources that are folders of trials have one.
        limitations: Sentences about plans that cannot be read, about trials whose evidence differs from the manifest
            or cannot be compared with it, and about trials that were left out because there are too many.
        changed_folders: Folders of attempts whose evidence differs from the manifest and therefore counts as not
            available.
        verified_sources: The `source` of the trials whose evidence was compared with the manifest, or could not be
            compared because of an error that `limitations` reports. The evidence of other trials counts as not
            available.
    """

    repeats: Repeats
    plans: Mapping[str, Plan]
    limitations: tuple[str, ...]
    changed_folders: frozenset[Path]
    verified_sources: frozenset[str]

    @property
    def n_conditions(self) -> int:
        """Number of conditions in the table."""
        return len(self._rows)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """Quantities of the table by name, in order."""
        return {quantity.name: quantity for quantity in self.repeats.quantities}

    @cached_property
    def _rows(self) -> Mapping[Key, NDArray[np.int64]]:
        started_ns = self.repeats.numbers["started_utc_ns"]
        groups = self.repeats.groups(DEFAULT_BY)
        return {key: rows[np.argsort(started_ns[rows], kind="stable")] for key, rows in groups.items()}

    def rows(self, cell: Cell) -> NDArray[np.int64]:
        """Return the rows of a cell's attempts in order of time."""
        return self._rows[tuple(cell.key[name] for name in DEFAULT_BY)]

    def measured_columns(self, cell: Cell) -> Set[str] | None:
        """Return the columns that the steps of a cell's trials measure, or None if no plan is available."""
        key = tuple(cell.key[name] for name in DEFAULT_BY)
        if key not in self._measured_columns:
            sources = dict.fromkeys(self.repeats.texts["source"][self.rows(cell)].tolist())
            plans = [self.plans[source] for source in sources if source in self.plans]
            steps = (placed.step for plan in plans for placed in plan.procedure.walk())
            names = frozenset(column.name for step in steps for column in columns_of_step(step))
            self._measured_columns[key] = names if plans else None
        return self._measured_columns[key]

    @cached_property
    def _measured_columns(self) -> dict[Key, Set[str] | None]:
        return {}

    def valid_rows(self, cell: Cell, name: str) -> NDArray[np.int64]:
        """Return the rows of a cell's valid repeats that have the column `name`, in order of time."""
        rows = self.rows(cell)
        is_valid = self.repeats.texts["status"][rows] == Status.VALID
        selected_rows: NDArray[np.int64] = rows[is_valid & np.isfinite(self.repeats.numbers[name][rows])]
        return selected_rows

    def observed(self, cell: Cell, quantity: Quantity) -> tuple[Numbers, NDArray[np.bool_]]:
        """Return the values of a cell's valid repeats in order of time, and a mask of the lower bounds among them."""
        rows = self.rows(cell)
        rows = rows[self.repeats.texts["status"][rows] == Status.VALID]
        values, is_bound = (column[rows] for column in self.repeats.observed(quantity))
        is_known = np.isfinite(values)
        return values[is_known], is_bound[is_known]

    def by_payload(self, cells: Sequence[Cell], step: str = "") -> Mapping[str, list[Cell]]:
        """Return cells by the payload size of their pings as returned by `payload`, empty if it is unknown.

        Cells with different sizes must not be compared.
        """
        cells_by_size: dict[str, list[Cell]] = {}
        for cell in cells:
            cells_by_size.setdefault(self.payload(cell, step), []).append(cell)
        return cells_by_size

    def payloads(self, cells: Iterable[Cell], step: str = "") -> list[str]:
        """Return the different known payload sizes of the pings of cells, `502 bytes`; `step` is the step's name."""
        return [size for size in dict.fromkeys(self.payload(cell, step) for cell in cells) if size]

    def payload(self, cell: Cell, step: str = "") -> str:
        """Return the payload size of a cell's pings, or an empty string if it is unknown.

        Examples: `502 bytes`; `56 or 502 bytes` if it differs between repeats.
        """
        name = f"{step}.rtt_payload_bytes".removeprefix(".")
        if name not in self.repeats.numbers:
            return ""
        sizes = np.unique(self.repeats.numbers[name][self.valid_rows(cell, name)])
        return f"{' or '.join(f'{size:.0f}' for size in sizes)} bytes" if len(sizes) else ""

    def plan(self, row: int) -> Plan | None:
        """Return the plan of a row's trial, or None if it is not available."""
        return self.plans.get(self.repeats.texts["source"][row])

    def attempt(self, row: int) -> AttemptEvidence | None:
        """Return a row's raw evidence, or None if it is not available."""
        plan, texts, name = self.plan(row), self.repeats.texts, self.repeats.folder(row)
        if (
            plan is None
            or name is None
            or texts["source"][row] not in self.verified_sources
            or plan.trial != texts["trial"][row]
        ):
            return None
        folder = store.attempt_folder(Path(texts["source"][row]), name)
        return AttemptEvidence(folder) if folder.is_dir() and folder not in self.changed_folders else None

    def pings(self, row: int, step: str = "") -> ping.Ping | None:
        """Return the output of ping in a row's attempt, optionally of a named step, or None if unavailable."""
        evidence, plan = self.attempt(row), self.plan(row)
        source = (
            next((candidate for candidate in planned_evidence.ping_sources(plan) if candidate.name == step), None)
            if plan
            else None
        )
        return evidence.read_or_none(ping.read, source.file) if evidence and source else None


def load_evidence(repeats: Repeats, attempt: str = "") -> Evidence:
    """Return a table of repeats with the evidence in its sources.

    All plans are read. The evidence of at most `MAX_TRIALS` trials is available.

    Args:
        repeats: The table.
        attempt: An attempt whose trial is among these in any case, in the form of `Repeats.row`; empty for none.

    Raises:
        ConfigurationError: There is no such attempt, or there are several.
    """
    plans: dict[str, Plan] = {}
    limitations, changed_folders = [], set[Path]()
    for source in dict.fromkeys(repeats.texts["source"].tolist()):
        if (Path(source) / PLAN_FILE).is_file():
            try:
                plans[source] = stored_plans.read_plan(Path(source))
            except FieldkitError as error:
                limitations.append(error.located)
    required_sources = [repeats.texts["source"][repeats.row(attempt)]] if attempt else []
    selected_sources = _choose_sources(repeats, plans, required_sources)
    for source in selected_sources:
        try:
            if differences := verification.differences(Path(source)):
                summary = verification.summarize(differences)
                limitations.append(f"{source}: evidence that differs from the manifest is left out: {summary}")
                # The first two parts of a name are the attempt's folder: `repeats/udp-07`.
                changed_folders |= {Path(source, *Path(name).parts[:2]) for name in differences}
        except FieldkitError as error:
            limitations.append(error.located)
    if len(selected_sources) < len(plans):
        limitations.append(
            f"Packets, replies and the time line are of {len(selected_sources)} of {len(plans)} trials, chosen "
            "evenly over the conditions; all other figures are of all trials. To choose other trials: --where."
        )
    return Evidence(
        repeats, MappingProxyType(plans), tuple(limitations), frozenset(changed_folders), frozenset(selected_sources)
    )


def _choose_sources(repeats: Repeats, plans: Mapping[str, Plan], required_sources: Iterable[str]) -> list[str]:
    """Return at most `MAX_TRIALS` sources with plans.

    If there are more, `required_sources` are chosen first, then one source per condition, then a second one per
    condition, and so on. The result has the order of `plans`.
    """
    if len(plans) <= MAX_TRIALS:
        return list(plans)
    condition_of = dict(zip(repeats.texts["source"].tolist(), repeats.keys(DEFAULT_BY), strict=True))
    counts: Counter[Key] = Counter()
    ranks = {}
    for source in plans:
        ranks[source] = counts[condition_of[source]]
        counts[condition_of[source]] += 1
    ranks |= dict.fromkeys((source for source in required_sources if source in plans), -1)
    selected_sources = set(sorted(plans, key=lambda source: ranks[source])[:MAX_TRIALS])
    return [source for source in plans if source in selected_sources]
