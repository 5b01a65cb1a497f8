"""Cells read back from the tables of docs/studies/middleware.md, with intervals, for figures without raw data.

The tables have the loss of all repeats together, so the differences between repeats are unknown. Losses occur in
fades of some tenths of a second, so samples within `TOGETHER_S` count as one trial of Wilson's interval. It is wider
than that of independent samples, but does not include differences between repeats.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.studies.middleware_cells import MiddlewareCell
from fieldkit.analysis.statistics import wilsons

TOGETHER_S: Final = 0.5
"""Samples within this time count as one trial."""
REPEATS: Final = 2
"""Repeats of the campaigns in the page."""
SIZES: Final = {"100 B": 100, "1 kB": 1_000, "10 kB": 10_000, "100 kB": 100_000, "1 MB": 1_000_000}

IMAGE_BYTES: Final = 1_000_000
_SAMPLES: Final = {True: (10, 2.0), False: (40, 10.0)}
"""Samples per repeat and rate in Hz of a stream, by True for images of 1 MB."""
_HEAD: Final = re.compile(r"(?P<number>[0-9]+) (?P<what>m|robots)")
_CELL: Final = re.compile(r"(?P<loss>[0-9.]+) %, (?:(?P<delay>[0-9]+) ms|-)(?: \*)?")
_PLACE: Final = re.compile(r"publish to one at (?P<metres>[0-9]+) m")


def samples_of(size_bytes: int, streams: int, repeats: int) -> int:
    """Return the number of samples that all repeats of a cell send."""
    return _SAMPLES[size_bytes >= IMAGE_BYTES][0] * streams * repeats


def interval(loss: float, size_bytes: int, samples: int) -> tuple[float, float]:
    """Return the 95 % interval of a loss, with samples within `TOGETHER_S` as one trial.

    Args:
        loss: Share of lost samples.
        size_bytes: Data of a sample, which determines the rate.
        samples: Number of samples.
    """
    _, rate_hz = _SAMPLES[size_bytes >= IMAGE_BYTES]
    trials = samples / max(rate_hz * TOGETHER_S, 1.0)
    limits = wilsons(np.array([loss * trials]), np.array([trials]))
    return float(limits.low[0]), float(limits.high[0])


def cells(page: Path) -> list[MiddlewareCell]:
    """Return the cells of the tables of loss and delay in a page."""
    result: list[MiddlewareCell] = []
    metres, columns = 0.0, list[tuple[float, bool]]()
    for line in page.read_text(encoding="utf-8").split("\n"):
        if place := _PLACE.search(line):
            metres = float(place["metres"])
        parts = [part.strip() for part in line.strip("|").split("|")] if line.startswith("| ") else []
        if parts[:3] == ["data", "kind", "middleware"]:
            heads = [match for part in parts[3:] if (match := _HEAD.fullmatch(part))]
            columns = [(float(match["number"]), match["what"] == "m") for match in heads]
        elif len(parts) == 3 + len(columns) and parts[0] in SIZES:
            result += _row(parts, columns, metres)
    return result


def _row(parts: Sequence[str], columns: Sequence[tuple[float, bool]], metres: float) -> Iterator[MiddlewareCell]:
    """Yield the cells of one table row."""
    size_bytes = SIZES[parts[0]]
    for text, (number, is_distance) in zip(parts[3:], columns, strict=True):
        match = _CELL.fullmatch(text)
        if match is None:
            continue
        robots = 2 if is_distance else int(number)
        samples, loss = samples_of(size_bytes, robots - 1, REPEATS), float(match["loss"]) / 100
        low, high = interval(loss, size_bytes, samples)
        yield MiddlewareCell(
            middleware=parts[2],
            kind=parts[1],
            size_bytes=size_bytes,
            distance_m=number if is_distance else metres,
            robots=robots,
            loss=loss,
            delay_p95_s=float(match["delay"]) / 1e3 if match["delay"] else None,
            loss_low=low,
            loss_high=high,
            samples=samples,
            repeats=REPEATS,
        )
