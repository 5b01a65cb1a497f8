"""Numbers of repeats by outcome under each condition, and of repeats without a value of a quantity, with the reason.

A cell contains the repeats under one condition, and their estimates.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.repeats import Repeats
from fieldkit.core.columns import plain_name, step_prefixed
from fieldkit.core.model import FINAL_STATUSES, Status
from fieldkit.report import wording
from fieldkit.report.trial_folders import Evidence

Rows = NDArray[np.bool_]

_LOSSES: Final = {
    "rtt": ("rtt_loss",),
    "topic": ("topic_loss",),
    "used": ("topic_loss",),
    "seen": ("topic_loss", "video_loss"),
    "video": ("video_loss",),
    "iperf3": ("iperf3_loss", "iperf3_captured_loss"),
}
"""Losses that belong to a quantity, by the first part of its column's name."""
_TRANSFER_LOSSES: Final = ("datagram_loss", "ip_loss", "tcp_byte_loss", "file_loss")
"""Losses that belong to all other quantities."""
_ALL_LOSSES: Final = frozenset((*_TRANSFER_LOSSES, *(name for names in _LOSSES.values() for name in names)))

NOTHING_ARRIVED: Final = "nothing arrived"
NO_VALUE: Final = "no value"
NO_VALID_REPEAT: Final = "no valid repeat"
"""Reasons for missing values; see `Absence.reason`."""


@dataclass(frozen=True)
class RepeatCounts:
    """Numbers of repeats under one condition by outcome.

    Attributes:
        planned: Planned repeats, at least the started ones, of the trials that have rows under the condition. For a
            trial without a plan, only the started repeats are counted.
        valid: Repeats with a valid attempt.
        void: Repeats without a valid attempt whose last attempt is void.
        failed: Repeats without a valid attempt whose last attempt failed.
        all_lost: Valid repeats in which nothing arrived.
    """

    planned: int
    valid: int
    void: int
    failed: int
    all_lost: int

    @property
    def missing(self) -> int:
        """Planned repeats without any attempt."""
        return self.planned - self.valid - self.void - self.failed


@dataclass(frozen=True)
class Absence:
    """Repeats under one condition that have no value of a quantity.

    Attributes:
        cell: The condition.
        reason: `nothing arrived`, `no value` or `no valid repeat`. `total_absences` can join the first two.
        count: Number of repeats without a value for this reason; number of attempts if no repeat is valid.
        total: Number of all repeats or attempts.
    """

    cell: Cell
    reason: str
    count: int
    total: int

    @property
    def share(self) -> str:
        """Number of affected repeats, `3 of 5`; if none is valid, the outcomes of attempts, `2 failed`."""
        if self.cell.n_valid:
            return f"{self.count} of {self.total}"
        outcomes = (("void", self.cell.n_void), ("failed", self.cell.n_failed))
        return ", ".join(f"{count} {status}" for status, count in outcomes if count)

    @property
    def text(self) -> str:
        """The absence in words: `nothing arrived: 3 of 5`."""
        return f"{self.reason}: {self.share}"


def repeat_counts(cell: Cell, evidence: Evidence, all_lost: Rows) -> RepeatCounts:
    """Return the numbers of repeats under one condition by outcome; `all_lost` as returned by `everything_lost`."""
    texts, rows = evidence.repeats.texts, evidence.rows(cell)
    last_statuses: dict[tuple[str, str, float], str] = {}
    for row in rows.tolist():  # in order of time
        key = texts["source"][row], texts["trial"][row], float(evidence.repeats.numbers["repeat"][row])
        if last_statuses.get(key) != Status.VALID:
            last_statuses[key] = texts["status"][row]
    statuses = list(last_statuses.values())
    planned = 0
    for source in {source for source, *_ in last_statuses}:
        plan = evidence.plans.get(source)
        started_count = sum(key[0] == source for key in last_statuses)
        planned += max(started_count, plan.repeats) if plan else started_count
    valid, void, failed = (statuses.count(status) for status in FINAL_STATUSES)
    is_all_lost = all_lost[rows] & (texts["status"][rows] == Status.VALID)
    return RepeatCounts(planned, valid, void, failed, int(is_all_lost.sum()))


def everything_lost(repeats: Repeats) -> Rows:
    """Return a mask of the rows with at least one known loss in which every known loss is total; shape (n,)."""
    names = [name for name in repeats.numbers if plain_name(name) in _ALL_LOSSES]
    return _all_lost([repeats.numbers[name] for name in names], len(repeats))


def nothing_arrived(repeats: Repeats, quantity: Quantity, rows: NDArray[np.int64]) -> Rows:
    """Return a mask of the given rows in which nothing arrived; shape of `rows`.

    This is the case if any loss that belongs to the quantity is total. If none of these is known in a row, every
    known loss of the row must be total.
    """
    kind = plain_name(quantity.name).partition("_")[0]
    related = {step_prefixed(quantity.step, loss) for loss in _LOSSES.get(kind, _TRANSFER_LOSSES)}
    losses = {name: column[rows] for name, column in repeats.numbers.items() if plain_name(name) in _ALL_LOSSES}
    related_columns = [column for name, column in losses.items() if name in related]
    is_all_lost = _all_lost(list(losses.values()), len(rows))
    if not related_columns:
        return is_all_lost
    is_known = np.any([np.isfinite(column) for column in related_columns], axis=0)
    is_related_lost = np.any([column >= 1 for column in related_columns], axis=0)
    lost: Rows = np.where(is_known, is_related_lost, is_all_lost)
    return lost


def _all_lost(columns: Sequence[NDArray[np.float64]], count: int) -> Rows:
    """Return a mask of the rows in which at least one loss is known and every known loss is total."""
    if not columns:
        return np.zeros(count, dtype=np.bool_)
    is_known = np.any([np.isfinite(column) for column in columns], axis=0)
    is_partial = np.any([column < 1 for column in columns], axis=0)  # False for a missing loss
    lost: Rows = is_known & ~is_partial
    return lost


def absences(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> Iterator[Absence]:
    """Yield the missing values of a quantity under conditions in which it should have been measured.

    Args:
        cells: Conditions. A condition is ignored if no condition of its protocol and topology has the quantity.
        quantity: The quantity.
        evidence: The table and the available plans.
    """
    measured_groups = {wording.group(cell) for cell in cells if quantity.name in cell.estimates}
    for cell in cells:
        if wording.group(cell) in measured_groups and _is_measured(cell, quantity, cells, evidence):
            yield from _absences_of(cell, quantity, evidence)


def total_absences(cells: Sequence[Cell], quantity: Quantity, evidence: Evidence) -> Iterator[Absence]:
    """Yield one item for each condition in which a quantity has no value at all; see `absences` for the arguments."""
    for _, parts in groupby(absences(cells, quantity, evidence), key=lambda absence: id(absence.cell)):
        first, *others = parts
        if first.count + sum(other.count for other in others) == first.total:
            reason = " or ".join((first.reason, *(other.reason for other in others)))
            yield replace(first, reason=reason, count=first.total)


def _is_measured(cell: Cell, quantity: Quantity, cells: Iterable[Cell], evidence: Evidence) -> bool:
    """Return True if the repeats of a cell should have a value of a quantity.

    The plan decides this. Without a plan, the result is True if the cell has no valid repeat, if a similar cell has
    the quantity, or if nothing arrived in one of the cell's attempts.
    """
    if quantity.name in cell.estimates:
        return True
    if (measured_columns := evidence.measured_columns(cell)) is not None:
        return quantity.name in measured_columns
    similar_by = ("procedure", "scenario", "topology", "backend", "protocol")
    similar = (other for other in cells if all(other.key[name] == cell.key[name] for name in similar_by))
    if not cell.n_valid or any(quantity.name in other.estimates for other in similar):
        return True
    return bool(nothing_arrived(evidence.repeats, quantity, evidence.rows(cell)).any())


def _absences_of(cell: Cell, quantity: Quantity, evidence: Evidence) -> Iterator[Absence]:
    """Yield the missing values of a quantity under one condition, one item per reason."""
    if not cell.n_valid:
        attempts = cell.n_void + cell.n_failed
        yield Absence(cell, NO_VALID_REPEAT, attempts, attempts)
        return
    rows = evidence.rows(cell)
    rows = rows[evidence.repeats.texts["status"][rows] == Status.VALID]
    rows_without_value = rows[~np.isfinite(evidence.repeats.observed(quantity)[0][rows])]
    silent_count = int(nothing_arrived(evidence.repeats, quantity, rows_without_value).sum())
    for reason, count in ((NOTHING_ARRIVED, silent_count), (NO_VALUE, len(rows_without_value) - silent_count)):
        if count:
            yield Absence(cell, reason, count, len(rows))
