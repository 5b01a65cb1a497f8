"""Results of the campaigns of benchmarks/studies/middleware/, by middleware, size, distance and number of robots."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

import fieldkit
from fieldkit.analysis.statistics import shares

CAMPAIGNS: Final = ("dds", "zenoh", "ros1", "robots", "ros2", "ros2-robots")
BYTES: Final = (100, 1_000, 10_000, 100_000, 1_000_000)
_NAMES: Final = {"dds": "CycloneDDS", "zenoh": "Zenoh", "ros1": "ROS 1", "ros2": "Fast DDS"}
_BEST_EFFORT: Final = frozenset({"sensor_data", "udp"})
_STREAM: Final = re.compile(
    r"(?:(?P<kind>sensor_data|default|tcp|udp)_)?(?P<settings>default|tuned)_(?P<bytes>[0-9]+)"
)
_SHARED: Final = re.compile(r"(?P<over>dds|zenoh|ros1|ros2)_robots(?P<robots>[0-9])_(?P<bytes>[0-9]+)")

Row = Mapping[str, Any]


@dataclass(frozen=True)
class MiddlewareCell:
    """One middleware with its settings, at one distance with one size of samples.

    Attributes:
        middleware: Name of the middleware, with `, tuned` if its settings are tuned.
        kind: `best effort` or `reliable`.
        size_bytes: Size of the data of a sample.
        distance_m: Distance between the robots.
        robots: Number of robots, including the subscriber.
        loss: Share of the samples of all valid repeats that did not arrive, or were not sent because the previous one
            blocked the publisher; None if the subscriber was not discovered.
        delay_p95_s: Median over repeats of the 95th percentile of the delay (of one publisher, if there are several);
            None if no repeat has one, for example because the clocks are not comparable.
        loss_low: Lower end of the 95 % interval of the loss over repeats; None if there are fewer than two repeats.
        loss_high: Upper end of this interval, or None.
        samples: Number of samples that arrived or did not arrive.
        repeats: Number of valid repeats with samples.
    """

    middleware: str
    kind: str
    size_bytes: int
    distance_m: float
    robots: int
    loss: float | None
    delay_p95_s: float | None
    loss_low: float | None = None
    loss_high: float | None = None
    samples: int = 0
    repeats: int = 0


@dataclass(frozen=True)
class MiddlewareFindings:
    """Results of campaigns.

    Attributes:
        cells: Cells of valid repeats.
        status_text: Number of repeats of each status, as text.
        ended_s: Time at which the last table was written, in seconds since 1970 UTC; 0 without tables.
        late_s: Largest lateness of a packet in valid repeats.
    """

    cells: Sequence[MiddlewareCell]
    status_text: str
    ended_s: float
    late_s: float


def read(folder: Path, names: Sequence[str]) -> MiddlewareFindings:
    """Return the results of the campaigns of a lab so far."""
    rows: dict[str, list[Row]] = {}
    newest_s = 0.0
    for name in names:
        campaign_folder = folder / "trials" / f"campaign_{name}"
        tables = sorted(campaign_folder.glob("*/trial.csv"))
        newest_s = max([newest_s, *(path.stat().st_mtime for path in tables)])
        rows[name] = fieldkit.load(campaign_folder).repeats.to_pylist() if tables else []
    all_rows = [row for campaign_rows in rows.values() for row in campaign_rows]
    valid = {name: [row for row in campaign_rows if row["status"] == "valid"] for name, campaign_rows in rows.items()}
    statuses = [row["status"] for row in all_rows]
    counts = (f"{statuses.count(status)} repeats {status}" for status in sorted(set(statuses), reverse=True))
    status_text = ", ".join(counts) or "nothing"
    late_s = max(
        (row["emulator_late_max_s"] or 0.0 for campaign_rows in valid.values() for row in campaign_rows), default=0.0
    )
    cells = [cell for name, campaign_rows in valid.items() for cell in _cells(_base_name(name), campaign_rows)]
    return MiddlewareFindings(cells, status_text, newest_s, late_s)


def _base_name(name: str) -> str:
    """Return the entry of `CAMPAIGNS` for a campaign: `dds` for `full-dds` and `dds-12`."""
    return re.sub(r"-[0-9]+$", "", name.removeprefix("full-"))


def _cells(campaign: str, rows: Sequence[Row]) -> Iterator[MiddlewareCell]:
    for metres in sorted({row["distance_m"] for row in rows}):
        distance_rows = [row for row in rows if row["distance_m"] == metres]
        streams = [name.removesuffix(".topic_sent") for name in distance_rows[0] if name.endswith(".topic_sent")]
        for stream in streams:
            if campaign.endswith("robots") and (match := _SHARED.fullmatch(stream)):
                together = [name for name in streams if re.fullmatch(rf"{stream}(_[0-9])?", name)]
                label, size, robots = _NAMES[match["over"]], int(match["bytes"]), int(match["robots"])
                cell = MiddlewareCell(
                    label,
                    "reliable",
                    size,
                    metres,
                    robots,
                    _loss(distance_rows, together),
                    _delay_s(distance_rows, stream),
                )
                yield _with_interval(cell, distance_rows, together)
            elif match := _STREAM.fullmatch(stream):
                label = _NAMES[campaign] + (", tuned" if match["settings"] == "tuned" else "")
                kind = "best effort" if match["kind"] in _BEST_EFFORT else "reliable"
                loss, delay_s = _loss(distance_rows, [stream]), _delay_s(distance_rows, stream)
                cell = MiddlewareCell(label, kind, int(match["bytes"]), metres, 2, loss, delay_s)
                yield _with_interval(cell, distance_rows, [stream])


def _loss(rows: Sequence[Row], streams: Sequence[str]) -> float | None:
    intended, received = (sum(counts) for counts in _counts(rows, streams))
    return 1 - received / intended if intended else None


def _counts(rows: Sequence[Row], streams: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the number of intended and of received samples of each repeat."""
    intended, received = (
        [sum(row[f"{stream}.topic_{name}"] or 0 for stream in streams for name in names) for row in rows]
        for names in (("sent", "refused", "skipped"), ("received",))
    )
    return intended, received


def _with_interval(cell: MiddlewareCell, rows: Sequence[Row], streams: Sequence[str]) -> MiddlewareCell:
    """Return a cell with the interval of its loss; the repeat is the independent unit."""
    counts = [pair for pair in zip(*_counts(rows, streams), strict=True) if pair[0]]
    if len(counts) < 2:
        return replace(cell, samples=sum(intended for intended, _ in counts), repeats=len(counts))
    intended, received = (np.array([column], dtype=np.float64) for column in zip(*counts, strict=True))
    interval = shares(intended - received, intended)
    low, high = float(interval.low[0]), float(interval.high[0])
    return replace(cell, loss_low=low, loss_high=high, samples=int(intended.sum()), repeats=len(counts))


def _delay_s(rows: Sequence[Row], stream: str) -> float | None:
    delays_s = [value for row in rows if (value := row[f"{stream}.topic_delay_p95_s"]) is not None]
    return median(delays_s) if delays_s else None
