"""Position samples of one robot from a bag, a telemetry log, a GPX file or a CSV file."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core import plugins
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import reading
from fieldkit.measure.evidence.sandbox import ReaderError, SandboxedReader
from fieldkit.measure.positions.position_sources import PositionSource
from fieldkit.measure.positions.samples import MAX_SAMPLES, WGS84, Samples, read_csv, require_increasing

MAX_STALE_S: Final = 10.0
"""If time stamps and reception times differ by more than this, they are from different clocks."""

PositionReader = Callable[[Path, PositionSource], Samples]
"""Function that returns the samples of a source in a file, and raises the same errors as `read_topic`."""

_GPX_READER: Final = SandboxedReader("fieldkit.measure.positions.gpx_reader")


def read_file(path: Path) -> Samples:
    """Return the samples in a GPX or CSV file, with the file's times unchanged. The name's suffix gives the format.

    Raises:
        EvidenceError: The file has another suffix, is missing or is invalid.
    """
    match path.suffix.lower():
        case ".csv":
            return read_csv(path)
        case ".gpx":
            return _read_gpx(path)
    raise EvidenceError("is neither GPX nor CSV", where=str(path), remedy="name a file that ends in .gpx or .csv")


def _read_gpx(path: Path) -> Samples:
    try:
        points = _GPX_READER.query({"path": str(path.absolute())}, reading.size(path))["points"]
    except ReaderError as error:
        raise EvidenceError(f"cannot be read as GPX: {error}", where=str(path)) from error
    if len(points) > MAX_SAMPLES:
        raise EvidenceError(
            f"has more than {MAX_SAMPLES} points", where=str(path), remedy="remove the points outside of the trial"
        )
    try:
        require_increasing(
            [at_ns for at_ns, *_ in points], [f"point {number}" for number in range(1, len(points) + 1)]
        )
    except EvidenceError as error:
        where = ", ".join(filter(None, (str(path), error.where)))
        raise EvidenceError(error.what, where=where, remedy=error.remedy) from error
    values = np.array(
        [[math.nan if value is None else value for value in point[1:]] for point in points], dtype=float
    )
    if not (np.isfinite(values[:, :2]).all() and (abs(values[:, :2]) <= (90, 180)).all()):
        raise EvidenceError("has a point with invalid coordinates", where=str(path), remedy="export the track again")
    return Samples(np.array([at_ns for at_ns, *_ in points]), values, WGS84)


def read_topic(path: Path, position_source: PositionSource) -> Samples:
    """Return the samples in a topic of a bag or in the messages of a type in a telemetry log.

    Their times are by the recorder's clock.

    Raises:
        EvidenceError: The file cannot be read or has no positions, or no package reads its format.
    """
    entry_point = _readers().get(path.suffix)
    if entry_point is None:
        raise EvidenceError("is not a recording in a known format", where=str(path))
    reader: PositionReader = plugins.load(entry_point)
    return reader(path, position_source)


@cache
def _readers() -> Mapping[str, EntryPoint]:
    """Return the entry points of the readers by file name suffix."""
    return {f".{point.name}": point for point in plugins.entry_points(plugins.POSITIONS)}


def to_placement_frame(samples: Samples, position_source: PositionSource) -> Samples:
    """Transform odometry to the frame of the placement, which states the planned positions of the robots.

    Args:
        samples: Odometry with times by the laptop's clock.
        position_source: Source with the place and heading of the robot at the start of the step, and the start time.

    Raises:
        EvidenceError: The heading is unknown, or the odometry has no sample at or before the start.
    """
    assert samples.yaws_rad is not None
    if position_source.heading_rad is None:
        raise EvidenceError(
            f"{position_source.topic} has no absolute direction, and the robot's initial heading is unknown"
        )
    at = int(np.searchsorted(samples.times_ns, position_source.began_utc_ns, side="right")) - 1
    if at < 0:
        late_s = (int(samples.times_ns[0]) - position_source.began_utc_ns) / 1e9
        raise EvidenceError(
            f"{position_source.topic} begins {late_s:.1f} s after the step started, so the robot's start is unknown"
        )
    turn_rad = position_source.heading_rad - float(samples.yaws_rad[at])
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    from_start_m = samples.values - samples.values[at]
    rotated = np.column_stack(
        (
            cos * from_start_m[:, 0] - sin * from_start_m[:, 1],
            sin * from_start_m[:, 0] + cos * from_start_m[:, 1],
            from_start_m[:, 2],
        )
    )
    return replace(samples, values=rotated + np.array(position_source.start))
