"""Samples of one robot's positions, a reader for CSV files of a tracking system, and a conversion to metres."""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.units import METRES_PER_UNIT, format_count
from fieldkit.measure.captures.arrays import Floats, Ints
from fieldkit.measure.evidence import reading

PLACED: Final = "as placed"
"""Frame of the procedure's placement in metres: from the sender towards the receiver, and to the left."""
WGS84: Final = "WGS 84"
"""Frame of latitude and longitude in degrees and height above the ellipsoid in metres."""
LOCAL: Final = "metres"
"""Frame of a file with metres from an unknown origin."""

MAX_SAMPLES: Final = 1_000_000
"""Maximum number of positions in a file."""
_MAX_NS: Final = 2**62  # in the year 2116
_NS_PER: Final = {"t_s": 10**9, "t_ms": 10**6, "t_us": 10**3, "t_ns": 1}
_UNIX_TIME: Final = re.compile(r"-?[0-9]{1,20}(?:\.[0-9]*)?", re.ASCII)
_AXES: Final = ("x", "y", "z")
_DEGREES: Final = {"lat": 90.0, "lon": 180.0}


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of one robot's positions.

    Attributes:
        times_ns: Nanoseconds since 1970 UTC by the source's clock, increasing. Shape (n,), n > 0.
        values: Positions in the frame: metres along three axes; or latitude and longitude in degrees and height in
            metres, NaN if the height is unknown. Shape (n, 3).
        frame: Frame of the values.
        yaws_rad: Headings of odometry; None if the source has no headings. Shape (n,).
    """

    times_ns: Ints
    values: Floats
    frame: str
    yaws_rad: Floats | None = None


def require_increasing(times_ns: Sequence[int], where: Sequence[str]) -> None:
    """Raise an error unless times increase.

    Args:
        times_ns: The times.
        where: Place of each time in its file, for the error message.

    Raises:
        EvidenceError: There are no times, two times are equal or in the wrong order, or a time is out of range.
    """
    if not times_ns:
        raise EvidenceError("has no position with a time", remedy="export the track again, with times")
    for index, at_ns in enumerate(times_ns):
        if not 0 <= at_ns < _MAX_NS:
            raise EvidenceError(
                "a time is before 1970 or after 2116", where=where[index], remedy="check the unit of the times"
            )
        if index and at_ns <= times_ns[index - 1]:
            what = (
                "a time occurs twice" if at_ns == times_ns[index - 1] else "a time is earlier than the previous one"
            )
            raise EvidenceError(what, where=where[index], remedy="sort the file by time, with one line for each time")


def read_csv(path: Path) -> Samples:
    """Return the samples in a CSV file with times and positions.

    The position columns are `x_m`, `y_m` and optionally `z_m`, or `lat`, `lon` and optionally `alt_m`. The suffix of
    a column of lengths is its unit. `t` is an ISO 8601 time with a time zone; `t_s`, `t_ms`, `t_us` and `t_ns` are
    times since 1970 UTC. Other columns are ignored.

    Raises:
        EvidenceError: The file is invalid; the error contains the file and the line.
    """
    rows = csv.reader(reading.text(path).removeprefix("\ufeff").splitlines(), strict=True)
    lines = _lines(rows, path)
    _, header = next(lines, (0, []))
    names = [name.strip().lower() for name in header]
    columns = _columns(names, str(path))
    times_ns: list[int] = []
    values: list[tuple[float, float, float]] = []
    line_places: list[str] = []
    for number, row in lines:
        where = f"{path}:{number}"
        if len(row) != len(names):
            raise EvidenceError(f"has {format_count(len(row), 'cell')}, but the header has {len(names)}", where=where)
        if len(values) == MAX_SAMPLES:
            remedy = "remove the lines outside of the trial"
            raise EvidenceError(f"has more than {MAX_SAMPLES} lines", where=str(path), remedy=remedy)
        times_ns.append(_time_ns(names[columns.time], row[columns.time].strip(), where))
        values.append(columns.value(row, where))
        line_places.append(where)
    try:
        require_increasing(times_ns, line_places)
    except EvidenceError as error:
        raise EvidenceError(error.what, where=error.where or str(path), remedy=error.remedy) from error
    return Samples(np.array(times_ns, dtype=np.int64), np.array(values), columns.frame)


def _lines(rows: Iterator[list[str]], path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and cells of each line that is not empty; raises `EvidenceError` if it is not CSV."""
    try:
        yield from ((number, row) for number, row in enumerate(rows, start=1) if row)
    except csv.Error as error:
        raise EvidenceError(f"is not valid CSV: {error}", where=str(path)) from error


@dataclass(frozen=True)
class _Columns:
    """Indices of the columns of a CSV file.

    Attributes:
        frame: Frame of the positions.
        time: Index of the time column.
        axes: For each axis, the column's index, the factor to metres or degrees, and the largest valid value. The
            third axis is None if the file has no column for it.
    """

    frame: str
    time: int
    axes: tuple[tuple[int, float, float] | None, ...]

    def value(self, row: Sequence[str], where: str) -> tuple[float, float, float]:
        """Return the position in a line."""
        first, second, third = (self._axis(axis, row, where) for axis in self.axes)
        return first, second, third

    def _axis(self, axis: tuple[int, float, float] | None, row: Sequence[str], where: str) -> float:
        if axis is None:
            return 0.0 if self.frame == LOCAL else math.nan
        index, factor, bound = axis
        try:
            value = float(row[index]) * factor
        except ValueError:
            value = math.nan
        if not abs(value) <= bound:  # the condition is also true for NaN
            raise EvidenceError(
                f"{row[index][:40]!r} is not a valid coordinate", where=where, remedy="correct or delete the line"
            )
        return value


def _columns(names: Sequence[str], where: str) -> _Columns:
    """Return the indices of the time and position columns.

    Raises:
        EvidenceError: There is not exactly one time column, or no complete set of position columns.
    """
    times = [index for index, name in enumerate(names) if name == "t" or name in _NS_PER]
    lengths = {
        f"{axis}_{unit}": (axis, factor) for axis in (*_AXES, "alt") for unit, factor in METRES_PER_UNIT.items()
    }
    axes: dict[str, tuple[int, float, float]] = {}
    for index, name in enumerate(names):
        if name in lengths:
            axis, factor = lengths[name]
            axes[axis] = (index, factor, 1e9)
        elif name.removesuffix("_deg") in _DEGREES:
            axes[name.removesuffix("_deg")] = (index, 1.0, _DEGREES[name.removesuffix("_deg")])
    remedy = (
        "name the columns t (with a time zone) or t_s, and x_m, y_m, z_m or lat, lon, alt_m; "
        "see: fieldkit docs positions"
    )
    if len(times) != 1:
        raise EvidenceError(f"has {len(times)} time columns; one is needed", where=where, remedy=remedy)
    if {"x", "y"} <= axes.keys() and not axes.keys() & _DEGREES.keys():
        return _Columns(LOCAL, times[0], (axes["x"], axes["y"], axes.get("z")))
    if {"lat", "lon"} <= axes.keys() and not axes.keys() & set(_AXES):
        return _Columns(WGS84, times[0], (axes["lat"], axes["lon"], axes.get("alt")))
    raise EvidenceError("has no complete set of position columns", where=where, remedy=remedy)


def _time_ns(name: str, text: str, where: str) -> int:
    """Return a time in nanoseconds since 1970 UTC; raises `EvidenceError` if the text is not a valid time.

    Args:
        name: Name of the column, which determines the format.
        text: The text in the cell.
        where: Place of the line, for the error message.
    """
    if name != "t":
        if not _UNIX_TIME.fullmatch(text):  # also rejects times with an exponent, which have too few digits: 1.7e9
            raise EvidenceError(
                f"{text[:40]!r} is not a time",
                where=where,
                remedy=f"write all digits of the time since 1970 UTC, without an exponent; {name} is in {name[2:]}",
            )
        return round(Decimal(text) * _NS_PER[name])  # a float cannot represent nanoseconds since 1970
    try:
        parsed = datetime.fromisoformat(text)
    except ValueError:
        raise EvidenceError(
            f"{text[:40]!r} is not a time", where=where, remedy="write it as 2026-11-22T10:00:00.5Z"
        ) from None
    if parsed.tzinfo is None:
        raise EvidenceError(
            f"{text[:40]!r} has no time zone", where=where, remedy="append Z or an offset like +02:00"
        )
    return utc_ns(parsed)


def utc_ns(moment: datetime) -> int:
    """Return a datetime with a time zone as nanoseconds since 1970 UTC, without rounding errors."""
    whole_seconds = moment.replace(microsecond=0)
    return round(whole_seconds.timestamp()) * 10**9 + moment.microsecond * 1000


SEMI_MAJOR_M: Final = 6_378_137.0
"""Semi-major axis of the ellipsoid (NIMA TR8350.2, table 3.1)."""
FLATTENING: Final = 1 / 298.257223563
"""Flattening of the ellipsoid (NIMA TR8350.2, table 3.1)."""

_ECCENTRICITY_2: Final = FLATTENING * (2 - FLATTENING)


def ecef_m(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> Floats:
    """Return earth-centred, earth-fixed coordinates in metres (ECEF; TR8350.2, equation 4-14).

    The distance between two such points is the length of the straight line between them. Over a distance d = 1 km,
    this line is shorter than the path along the ground by d^3 / (24 R^2) = 1 um.

    Args:
        latitude_deg: Degrees north. Shape (n,).
        longitude_deg: Degrees east. Shape (n,).
        height_m: Metres above the ellipsoid. Shape (n,).

    Returns:
        Shape (n, 3).
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    prime_vertical_m = SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_2 * np.sin(latitude) ** 2)
    from_axis_m = (prime_vertical_m + height_m) * np.cos(latitude)
    return np.column_stack(
        (
            from_axis_m * np.cos(longitude),
            from_axis_m * np.sin(longitude),
            ((1 - _ECCENTRICITY_2) * prime_vertical_m + height_m) * np.sin(latitude),
        )
    )
