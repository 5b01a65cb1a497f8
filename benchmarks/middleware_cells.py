"""What the campaigns of benchmarks/middleware/ measured, by middleware, size, distance and number of robots."""

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
    """One middleware with its settings, at one place with one size of samples.

    Attributes:
        who: The middleware, and `tuned` where its settings are.
        kind: `best effort` or `reliable`.
        size_bytes: Data of a sample.
        distance_m: Between the robots.
        robots: How many, the one that hears among them.
        loss: Share of all samples of all valid repeats that did not arrive, or were never sent since the one before
            still held its publisher up; None where nobody was found.
        delay_p95_s: Median over repeats of the 95th percentile of the delay; None where the clocks do not tell.
        expected_loss: What that loss were if each packet were lost by itself, with the share of packets that was;
            None where samples do not go in packets of UDP.
        loss_low: Lower end of the 95 % interval of the loss, over repeats; None without one.
        loss_high: Upper end.
        samples: How many samples the loss is of.
        repeats: Of how many repeats.
    """

    who: str
    kind: str
    size_bytes: int
    distance_m: float
    robots: int
    loss: float | None
    delay_p95_s: float | None
    expected_loss: float | None = None
    loss_low: float | None = None
    loss_high: float | None = None
    samples: int = 0
    repeats: int = 0


@dataclass(frozen=True)
class MiddlewareFindings:
    """What campaigns measured.

    Attributes:
        cells: Of valid repeats.
        ended: How many repeats ended how, in words.
        ended_s: When the last of them did, in seconds since 1970 UTC.
        late_s: The latest packet of the valid ones.
    """

    cells: Sequence[MiddlewareCell]
    ended: str
    ended_s: float
    late_s: float


def read(folder: Path, names: Sequence[str]) -> MiddlewareFindings:
    """Return what the campaigns of a lab have measured so far."""
    rows: dict[str, list[Row]] = {}
    newest_s = 0.0
    for name in names:
        there = folder / "trials" / f"campaign_{name}"
        tables = sorted(there.glob("*/trial.csv"))
        newest_s = max([newest_s, *(one.stat().st_mtime for one in tables)])
        rows[name] = fieldkit.load(there).repeats.to_pylist() if tables else []
    every = [row for some in rows.values() for row in some]
    valid = {name: [row for row in some if row["status"] == "valid"] for name, some in rows.items()}
    statuses = [row["status"] for row in every]
    ended = ", ".join(f"{statuses.count(one)} repeats {one}" for one in sorted(set(statuses), reverse=True))
    late_s = max((row["emulator_late_max_s"] or 0.0 for some in valid.values() for row in some), default=0.0)
    cells = [cell for name, some in valid.items() for cell in _cells(_kind(name), some)]
    return MiddlewareFindings(cells, ended or "nothing", newest_s, late_s)


def _kind(name: str) -> str:
    """Return which of `CAMPAIGNS` a campaign is: `dds` of `full-dds` and `dds-12`."""
    return re.sub(r"-[0-9]+$", "", name.removeprefix("full-"))


def _cells(campaign: str, rows: Sequence[Row]) -> Iterator[MiddlewareCell]:
    for metres in sorted({row["distance_m"] for row in rows}):
        here = [row for row in rows if row["distance_m"] == metres]
        streams = [name.removesuffix(".topic_sent") for name in here[0] if name.endswith(".topic_sent")]
        for stream in streams:
            if campaign.endswith("robots") and (one := _SHARED.fullmatch(stream)):
                together = [name for name in streams if re.fullmatch(rf"{stream}(_[0-9])?", name)]
                who, size, robots = _NAMES[one["over"]], int(one["bytes"]), int(one["robots"])
                cell = MiddlewareCell(
                    who, "reliable", size, metres, robots, _loss(here, together), _delay_s(here, stream)
                )
                yield _with_interval(cell, here, together)
            elif one := _STREAM.fullmatch(stream):
                who = _NAMES[campaign] + (", tuned" if one["settings"] == "tuned" else "")
                kind = "best effort" if one["kind"] in _BEST_EFFORT else "reliable"
                expected = _expected(here, stream) if kind == "best effort" else None
                loss, delay_s = _loss(here, [stream]), _delay_s(here, stream)
                cell = MiddlewareCell(who, kind, int(one["bytes"]), metres, 2, loss, delay_s, expected)
                yield _with_interval(cell, here, [stream])


def _loss(rows: Sequence[Row], streams: Sequence[str]) -> float | None:
    wanted, received = (sum(counts) for counts in _counts(rows, streams))
    return 1 - received / wanted if wanted else None


def _counts(rows: Sequence[Row], streams: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return per repeat how many samples there were to be, and how many arrived."""
    wanted, received = (
        [sum(row[f"{one}.topic_{name}"] or 0 for one in streams for name in names) for row in rows]
        for names in (("sent", "refused", "skipped"), ("received",))
    )
    return wanted, received


def _with_interval(cell: MiddlewareCell, rows: Sequence[Row], streams: Sequence[str]) -> MiddlewareCell:
    """Return a cell with the interval of its loss, the repeat being the independent unit."""
    counts = [pair for pair in zip(*_counts(rows, streams), strict=True) if pair[0]]
    if len(counts) < 2:
        return replace(cell, samples=sum(wanted for wanted, _ in counts), repeats=len(counts))
    wanted, received = (np.array([column], dtype=np.float64) for column in zip(*counts, strict=True))
    found = shares(wanted - received, wanted)
    low, high = float(found.low[0]), float(found.high[0])
    return replace(cell, loss_low=low, loss_high=high, samples=int(wanted.sum()), repeats=len(counts))


def _delay_s(rows: Sequence[Row], stream: str) -> float | None:
    told = [value for row in rows if (value := row[f"{stream}.topic_delay_p95_s"]) is not None]
    return median(told) if told else None


def _expected(rows: Sequence[Row], stream: str) -> float | None:
    """Return the loss of samples if each of their packets were lost by itself: 1 - (1 - p)^n."""
    sent = sum(row[f"{stream}.topic_sent"] or 0 for row in rows)
    packets = sum(row[f"{stream}.topic_data_packets"] or 0 for row in rows)
    lost = sum(
        (row[f"{stream}.topic_packet_loss"] or 0.0) * (row[f"{stream}.topic_data_packets"] or 0) for row in rows
    )
    return 1 - (1 - lost / packets) ** (packets / sent) if sent and packets else None
