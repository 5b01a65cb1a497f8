"""Packet rasters: the packets of each repeat in the order of sending; lost or retransmitted packets are marked.

A cell contains the repeats under one condition, and their estimates.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.analysis.cells import Cell
from fieldkit.core.model import Protocol, Status
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Mask
from fieldkit.measure.transfers import fates
from fieldkit.report import wording
from fieldkit.report.series import panels
from fieldkit.report.trial_folders import Evidence
from fieldkit.trial import planned_evidence

MAX_REPEATS: Final = 400
"""Maximum number of repeats whose captures are read, divided equally among the cells. Each cell shows at least its
first valid repeat with captures."""
MAX_LINES: Final = 20
"""Maximum number of lines of a raster."""
MAX_COLUMNS: Final = 300
"""Maximum number of columns of a line. If a line has more packets, each column represents several packets and is
marked if any of them is marked."""

_MARK_MEANING: Final = {Protocol.UDP: "IP packets lost", Protocol.TCP: "segments retransmitted"}


@dataclass(frozen=True)
class Raster:
    """A raster with a line per repeat and a column per packet.

    Attributes:
        place: Distance, and the scenario, procedure and backend if they differ between cells.
        lines: Number of lines.
        columns: Number of columns of the longest line.
        lengths: Number of columns of each line.
        runs: Runs of marked columns as (line, first column, number of columns).
        description: Description for screen readers.
    """

    place: str
    lines: int
    columns: int
    lengths: Sequence[int]
    runs: Sequence[tuple[int, int, int]]
    description: str


@dataclass(frozen=True)
class RasterGroup:
    """Rasters of one transfer with one protocol and topology.

    Attributes:
        title: Name of the transfer, if it has one, protocol and topology.
        what: The meaning of a mark, and the number of packets per column.
        rasters: One per condition whose captures are available.
    """

    title: str
    what: str
    rasters: Sequence[Raster]


def groups(cells: Sequence[Cell], evidence: Evidence) -> Iterator[RasterGroup]:
    """Yield the rasters of all cells whose captures are available."""
    differing = wording.differing(cells) - {"topology"}
    max_lines = min(MAX_LINES, max(1, MAX_REPEATS // max(1, len(cells))))
    for title, group in panels(cells).items():
        packets_by_place = {
            wording.place(cell, differing=differing): _marked_packets(cell, evidence, max_lines) for cell in group
        }
        for transfer in dict.fromkeys(name for lines in packets_by_place.values() for name in lines):
            marked_lines = {place: lines.get(transfer, []) for place, lines in packets_by_place.items()}
            longest = max(len(line) for lines in marked_lines.values() for line in lines)
            width = math.ceil(longest / MAX_COLUMNS)
            what = _MARK_MEANING[transfer[1]]
            yield RasterGroup(
                title=", ".join(filter(None, (transfer[0], title))),
                what=what if width == 1 else f"{what}; a column is {width} packets, marked if any of them is",
                rasters=[_raster(place, lines, width, what) for place, lines in marked_lines.items() if lines],
            )


def _marked_packets(cell: Cell, evidence: Evidence, max_lines: int) -> dict[tuple[str, Protocol], list[Mask]]:
    """Return masks of the marked packets, one mask per valid repeat, by name and protocol of the transfer.

    Only the first `max_lines` valid repeats with captures are read.
    """
    masks: dict[tuple[str, Protocol], list[Mask]] = {}
    for row in evidence.rows(cell).tolist():
        attempt, plan = evidence.attempt(row), evidence.plan(row)
        if attempt is None or plan is None or evidence.repeats.texts["status"][row] != Status.VALID:
            continue
        for transfer in planned_evidence.transfers(plan, Protocol(evidence.repeats.texts["protocol"][row])):
            if (packets := fates.read(attempt, transfer)) is not None:
                masks.setdefault((transfer.name, transfer.protocol), []).append(packets.lost_or_repeated)
        if max(map(len, masks.values()), default=0) == max_lines:
            break
    return masks


def _raster(place: str, lines: Sequence[Mask], width: int, what: str) -> Raster:
    """Return the raster of a condition, with `width` packets per column."""
    columns = [np.logical_or.reduceat(line, np.arange(0, len(line), width)) for line in lines]
    longest = max((length for line in lines for _, length in _runs(line)), default=0)
    total, marked_count = sum(map(len, lines)), sum(int(line.sum()) for line in lines)
    return Raster(
        place=place,
        lines=len(lines),
        columns=max(map(len, columns)),
        lengths=[len(line) for line in columns],
        runs=[(number, *run) for number, line in enumerate(columns) for run in _runs(line)],
        description=f"{place}: {format_count(len(lines), 'repeat')}, {marked_count} of {total} {what}, at most "
        f"{longest} in a row",
    )


def _runs(mask: Mask) -> list[tuple[int, int]]:
    """Return the first column and the length of each run of marked columns."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return [(int(start), int(stop - start)) for start, stop in edges.reshape(-1, 2)]
