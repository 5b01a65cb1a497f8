"""The table docs/studies/middleware.csv: written from cells, and read back with intervals, without raw data.

The table has the loss of all repeats together, so the differences between repeats are unknown. Losses occur in
fades of some tenths of a second, so samples within `TOGETHER_S` count as one trial of Wilson's interval. This makes
the interval wider than for independent samples, but it does not include differences between repeats.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.studies.middleware_cells import MiddlewareCell
from fieldkit.analysis.statistics import wilson_intervals

TOGETHER_S: Final = 0.5
"""Samples within this time count as one trial."""
REPEATS: Final = 2
"""Repeats of the campaigns in the table."""
HEAD: Final = ("size_bytes", "kind", "middleware", "robots", "distance_m", "lost_percent", "delay_p95_ms", "loss")
"""Columns of the table; `loss` is `bimodal` if each repeat loses either few samples or nearly all of them."""
BIMODAL: Final = "bimodal"

IMAGE_BYTES: Final = 1_000_000
_SAMPLES: Final = {True: (10, 2.0), False: (40, 10.0)}
"""Samples per repeat and rate in Hz of a stream; the key is True for images of 1 MB."""


def samples_of(size_bytes: int, streams: int, repeats: int) -> int:
    """Return the number of samples that all repeats of a cell send."""
    return _SAMPLES[size_bytes >= IMAGE_BYTES][0] * streams * repeats


def interval(loss: float, size_bytes: int, samples: int) -> tuple[float, float]:
    """Return the 95 % interval of a loss, with samples within `TOGETHER_S` as one trial.

    Args:
        loss: Share of lost samples.
        size_bytes: Size of the data of a sample, which determines the rate.
        samples: Number of samples.
    """
    _, rate_hz = _SAMPLES[size_bytes >= IMAGE_BYTES]
    trials = samples / max(rate_hz * TOGETHER_S, 1.0)
    limits = wilson_intervals(np.array([loss * trials]), np.array([trials]))
    return float(limits.low[0]), float(limits.high[0])


def is_bimodal(cell: MiddlewareCell) -> bool:
    """Return True for large reliable samples over Zenoh with default settings.

    In the campaigns each of their repeats lost either few samples or nearly all of them.
    """
    return (cell.middleware, cell.kind) == ("Zenoh", "reliable") and cell.size_bytes >= IMAGE_BYTES


def text(cells: Sequence[MiddlewareCell], middlewares: Sequence[str]) -> str:
    """Return the cells as CSV, sorted by size, kind, place in `middlewares`, number of robots and distance."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(HEAD)
    for cell in sorted(
        cells,
        key=lambda cell: (
            cell.size_bytes,
            cell.kind,
            middlewares.index(cell.middleware),
            cell.robots,
            cell.distance_m,
        ),
    ):
        lost = "" if cell.loss is None else f"{100 * cell.loss:.1f}"
        delay = "" if cell.delay_p95_s is None else f"{1e3 * cell.delay_p95_s:.0f}"
        place = (cell.robots, f"{cell.distance_m:g}")
        loss = BIMODAL if is_bimodal(cell) else ""
        writer.writerow((cell.size_bytes, cell.kind, cell.middleware, *place, lost, delay, loss))
    return table.getvalue()


def cells(path: Path) -> list[MiddlewareCell]:
    """Return the cells of a table that have a loss, with their intervals."""
    with path.open(encoding="utf-8", newline="") as file:
        return [_cell(row) for row in csv.DictReader(file) if row["lost_percent"]]


def _cell(row: dict[str, str]) -> MiddlewareCell:
    size_bytes, robots, loss = int(row["size_bytes"]), int(row["robots"]), float(row["lost_percent"]) / 100
    samples = samples_of(size_bytes, robots - 1, REPEATS)
    low, high = interval(loss, size_bytes, samples)
    return MiddlewareCell(
        middleware=row["middleware"],
        kind=row["kind"],
        size_bytes=size_bytes,
        distance_m=float(row["distance_m"]),
        robots=robots,
        loss=loss,
        delay_p95_s=float(row["delay_p95_ms"]) / 1e3 if row["delay_p95_ms"] else None,
        loss_low=low,
        loss_high=high,
        samples=samples,
        repeats=REPEATS,
    )
