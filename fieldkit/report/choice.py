"""Which repeat a report looks into."""

from collections.abc import Sequence

import numpy as np

from fieldkit.analysis.cells import Cell
from fieldkit.analysis.quantities import LOSSES
from fieldkit.core.errors import ConfigurationError, nearest
from fieldkit.core.model import Status
from fieldkit.report.evidence import Evidence


def chosen(cells: Sequence[Cell], found: Evidence, wanted: str) -> int | None:
    """Return the row whose time line is drawn.

    Args:
        cells: Conditions.
        found: The table and what is at hand beside it.
        wanted: Folder of an attempt, `udp-07`, with `TRIAL/` before it where several trials have one; empty for the
            valid repeat with the median loss, under the condition that loses most.

    Returns:
        None when nothing was wanted and no evidence is at hand.

    Raises:
        ConfigurationError: There is no such attempt.
    """
    if wanted:
        return _wanted(found, wanted)
    for name in LOSSES:
        lossy = [cell for cell in cells if name in cell.estimates]
        for cell in sorted(lossy, key=lambda one: one.estimates[name].value, reverse=True):
            loss = found.repeats.numbers[name]
            rows = [row for row in found.rows(cell).tolist() if _is_whole(found, row) and np.isfinite(loss[row])]
            if rows:
                return int(sorted(rows, key=lambda row: loss[row])[(len(rows) - 1) // 2])
    return None


def _is_whole(found: Evidence, row: int) -> bool:
    return found.repeats.texts["status"][row] == Status.VALID and found.attempt(row) is not None


def _wanted(found: Evidence, wanted: str) -> int:
    names: dict[str, int] = {}
    for row in range(len(found.repeats)):
        if evidence := found.attempt(row):
            names.setdefault(evidence.folder.name, row)
            names.setdefault(f"{found.repeats.texts['trial'][row]}/{evidence.folder.name}", row)
    if wanted not in names:
        raise ConfigurationError(
            f"--repeat: there is no evidence of {wanted!r} at hand",
            remedy=nearest(wanted, names, "name a folder below repeats/ of a trial, for example udp-07"),
        )
    return names[wanted]
