"""Strip charts: marks of attempts in order of time, with the loss as the height of a mark.

A cell contains the repeats under one condition, and their estimates.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import LOSSES, Quantity, with_plain_name
from fieldkit.core.model import Status
from fieldkit.report import wording
from fieldkit.report.series import Identities, panels
from fieldkit.report.theme import Colour
from fieldkit.report.trial_folders import Evidence

MAX_MARKS: Final = 2000
"""Maximum number of marks on a page, divided equally among its strips. If a strip has more valid attempts, about
every k-th of them has a mark."""
MAX_OTHER_MARKS: Final = 2000
"""Maximum number of marks of void and failed attempts on a page; see `MAX_MARKS`."""
MIN_MARKS: Final = 20
"""Number of valid attempts, and of other attempts, that a strip shows even if it exceeds its share of the maxima."""


@dataclass(frozen=True)
class Mark:
    """One attempt.

    Attributes:
        row: Its row in the table.
        status: Its status.
        height: Its loss divided by the highest loss in strips of the same protocol; 0 if this highest loss is 0. None
            if the attempt is not valid or its loss is unknown.
        title: Description for a tooltip or a screen reader.
    """

    row: int
    status: str
    height: float | None
    title: str


@dataclass(frozen=True)
class Strip:
    """The attempts of one cell.

    Attributes:
        cell: The cell.
        place: Distance, and the scenario, procedure and backend if they differ between cells.
        colour: Colour of its series.
        marks: Marks in order of time.
        omitted_count: Number of valid attempts without a mark.
        omitted_other_count: Number of void and failed attempts without a mark.
    """

    cell: Cell
    place: str
    colour: Colour
    marks: Sequence[Mark]
    omitted_count: int
    omitted_other_count: int


@dataclass(frozen=True)
class StripGroup:
    """Strips with the same scale of heights.

    Attributes:
        title: Protocol and topology.
        scale: The meaning of a mark of full height; empty if no loss was measured.
        strips: A strip per cell.
    """

    title: str
    scale: str
    strips: Sequence[Strip]


def groups(cells: Sequence[Cell], identities: Identities, evidence: Evidence) -> Iterator[StripGroup]:
    """Yield the strips of all cells, grouped by protocol and topology."""
    differing = wording.differing(cells) - {"topology"}
    limits = [max(MIN_MARKS, limit // max(1, len(cells))) for limit in (MAX_MARKS, MAX_OTHER_MARKS)]
    for title, group in panels(cells).items():
        heights = _heights(group, [cell for cell in cells if cell.key["protocol"] == group[0].key["protocol"]])
        strips = []
        for cell in group:
            rows = evidence.rows(cell)
            is_valid = evidence.repeats.texts["status"][rows] == Status.VALID
            other_rows = _evenly(rows[~is_valid], limits[1])
            valid_rows = _evenly(rows[is_valid], max(MIN_MARKS, limits[0] - len(other_rows)))
            marked_rows = rows[np.isin(rows, np.concatenate((valid_rows, other_rows)))]
            strips.append(
                Strip(
                    cell=cell,
                    place=wording.place(cell, differing=differing),
                    colour=identities.of(cell).style.colour,
                    marks=[_mark(row, heights, evidence) for row in marked_rows.tolist()],
                    omitted_count=int(is_valid.sum()) - len(valid_rows),
                    omitted_other_count=int((~is_valid).sum()) - len(other_rows),
                )
            )
        yield StripGroup(title, str(heights), strips)


@dataclass(frozen=True)
class _Heights:
    """The scale of the marks' heights.

    Attributes:
        loss: The first quantity of `LOSSES` that is measured; None if none is.
        full_height_loss: The loss at which a mark has its full height, 0 to 1; 0 if nothing was lost or measured.
    """

    loss: Quantity | None
    full_height_loss: float

    def of(self, loss: float) -> float | None:
        """Return the height of a mark for a loss; None for NaN."""
        if np.isnan(loss):
            return None
        return min(1.0, max(0.0, loss / self.full_height_loss)) if self.full_height_loss > 0 else 0.0

    def __str__(self) -> str:
        if self.loss is None:
            return ""
        height = f"full height {100 * self.full_height_loss:.1f} %" if self.full_height_loss > 0 else "none"
        return f"{self.loss.label}, {height}"


def _heights(group: Sequence[Cell], cells: Sequence[Cell]) -> _Heights:
    """Return the scale of a group of cells, which is equal for all groups of a protocol that show the same loss."""
    measured = dict.fromkeys(estimate.quantity for cell in group for estimate in cell.estimates.values())
    loss = next((quantity for name in LOSSES for quantity in with_plain_name(measured, name)), None)
    if loss is None:
        return _Heights(None, 0.0)
    return _Heights(loss, max(cell.estimates[loss.name].maximum for cell in cells if loss.name in cell.estimates))


def _evenly(rows: NDArray[np.int64], max_count: int) -> NDArray[np.int64]:
    """Return the rows, or `max_count` of them at equal distances."""
    if len(rows) <= max_count:
        return rows
    evenly_spaced: NDArray[np.int64] = rows[np.linspace(0, len(rows) - 1, max_count).round().astype(np.int64)]
    return evenly_spaced


def _mark(row: int, heights: _Heights, evidence: Evidence) -> Mark:
    """Return the mark of the attempt in a row."""
    texts, numbers = evidence.repeats.texts, evidence.repeats.numbers
    status = texts["status"][row]
    loss = float(numbers[heights.loss.name][row]) if heights.loss else np.nan
    parts = [evidence.repeats.name(row), status]
    if status != Status.VALID:
        parts[-1] += f": {texts['reason'][row] or 'no reason given'}"
    if heights.loss and np.isfinite(loss):
        parts.append(f"{heights.loss.label} {100 * loss:.2f} %")
    return Mark(row, status, heights.of(loss) if status == Status.VALID else None, ", ".join(parts))
