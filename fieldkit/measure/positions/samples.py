"""Samples of where one robot was, as a file or a bag gives them, and the CSV that a lab writes by itself."""

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
from fieldkit.core.units import METRES_PER_UNIT
from fieldkit.measure.captures.arrays import Floats, Ints
from fieldkit.measure.evidence import reading

PLACED: Final = "as placed"
"""Frame of what is told from where the procedure places robots: metres from the sender towards the receiver, and to
the left."""
WGS84: Final = "WGS 84"
"""Frame of degrees north and east, and metres over the ellipsoid."""
LOCAL: Final = "metres"
"""Frame of a file that gives metres and says nothing of from where."""

MOST_SAMPLES: Final = 1_000_000
_MOST_NS: Final = 2**62
_NS_PER: Final = {"t_s": 10**9, "t_ms": 10**6, "t_us": 10**3, "t_ns": 1}
_COUNTED: Final = re.compile(r"-?[0-9]{1,20}(?:\.[0-9]*)?", re.ASCII)
_AXES: Final = ("x", "y", "z")
_DEGREES: Final = {"lat": 90.0, "lon": 180.0}


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of where one robot was.

    Attributes:
        times_ns: When, by whatever clock, nanoseconds since 1970 UTC; rising. Shape (n,), at least one.
        values: Where, in the frame: metres along three axes, or degrees north and east and metres up, NaN where no
            height is told. Shape (n, 3).
        frame: What the values are in.
        yaws_rad: Where an odometry has the robot head; None where nothing of the kind is told. Shape (n,).
    """

    times_ns: Ints
    values: Floats
    frame: str
    yaws_rad: Floats | None = None


def demand_rising(times_ns: Sequence[int], where: Sequence[str]) -> None:
    """Refuse times that do not rise.

    Args:
        times_ns: The times.
        where: Where each stands.

    Raises:
        EvidenceError: Two are equal or the wrong way round, one is before 1970 or far ahead, or there is none.
    """
    if not times_ns:
        raise EvidenceError("holds no position with a time", remedy="export the track again, with times")
    for index, at_ns in enumerate(times_ns):
        if not 0 <= at_ns < _MOST_NS:
            raise EvidenceError(
                "a time is before 1970 or after 2116", where=where[index], remedy="which unit is it in?"
            )
        if index and at_ns <= times_ns[index - 1]:
            what = "a time comes twice" if at_ns == times_ns[index - 1] else "a time is before the one above it"
            raise EvidenceError(what, where=where[index], remedy="sort the file by time, and leave one line of each")


def read_csv(path: Path) -> Samples:
    """Return what stands in a CSV: `t` and `x_m`, `y_m`, or `lat`, `lon`; a height, `z_m` or `alt_m`, if it is known.

    `t` is a time as in ISO 8601, with its zone; `t_s`, `t_ms`, `t_us` and `t_ns` count from 1970 UTC. Lengths may
    have any unit, which the name ends in. Other columns are passed over.

    Raises:
        EvidenceError: It is not such a file; file and line are named.
    """
    rows = csv.reader(reading.text(path).removeprefix("\ufeff").splitlines(), strict=True)
    lines = _lines(rows, path)
    _, header = next(lines, (0, []))
    names = [name.strip().lower() for name in header]
    columns = _columns(names, str(path))
    times_ns: list[int] = []
    values: list[tuple[float, float, float]] = []
    places: list[str] = []
    for number, row in lines:
        where = f"{path}:{number}"
        if len(row) != len(names):
            raise EvidenceError(f"has {len(row)} cells, and the header {len(names)}", where=where)
        if len(values) == MOST_SAMPLES:
            raise EvidenceError(f"has more than {MOST_SAMPLES} lines", where=str(path), remedy="cut it to the trial")
        times_ns.append(_time_ns(names[columns.time], row[columns.time].strip(), where))
        values.append(columns.value(row, where))
        places.append(where)
    try:
        demand_rising(times_ns, places)
    except EvidenceError as error:
        raise EvidenceError(error.what, where=error.where or str(path), remedy=error.remedy) from error
    return Samples(np.array(times_ns, dtype=np.int64), np.array(values), columns.frame)


def _lines(rows: Iterator[list[str]], path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a CSV that are not empty, by number."""
    try:
        yield from ((number, row) for number, row in enumerate(rows, start=1) if row)
    except csv.Error as error:
        raise EvidenceError(f"is no CSV: {error}", where=str(path)) from error


@dataclass(frozen=True)
class _Columns:
    """Which column holds what.

    Attributes:
        frame: What the places are in.
        time: Index of the time.
        axes: Index of each axis with the factor that makes metres or degrees of it, and its bound; None where no
            column tells the height.
    """

    frame: str
    time: int
    axes: tuple[tuple[int, float, float] | None, ...]

    def value(self, row: Sequence[str], where: str) -> tuple[float, float, float]:
        """Return the place in a line."""
        one, two, three = (self._axis(axis, row, where) for axis in self.axes)
        return one, two, three

    def _axis(self, axis: tuple[int, float, float] | None, row: Sequence[str], where: str) -> float:
        if axis is None:
            return 0.0 if self.frame == LOCAL else math.nan
        index, factor, bound = axis
        try:
            value = float(row[index]) * factor
        except ValueError:
            value = math.nan
        if not abs(value) <= bound:  # nor NaN
            raise EvidenceError(
                f"{row[index][:40]!r} is no place", where=where, remedy="mend the line, or take it out"
            )
        return value


def _columns(names: Sequence[str], where: str) -> _Columns:
    """Return which columns hold time and place."""
    times = [index for index, name in enumerate(names) if name == "t" or name in _NS_PER]
    lengths = {
        f"{axis}_{unit}": (axis, factor) for axis in (*_AXES, "alt") for unit, factor in METRES_PER_UNIT.items()
    }
    found: dict[str, tuple[int, float, float]] = {}
    for index, name in enumerate(names):
        if name in lengths:
            axis, factor = lengths[name]
            found[axis] = (index, factor, 1e9)
        elif name.removesuffix("_deg") in _DEGREES:
            found[name.removesuffix("_deg")] = (index, 1.0, _DEGREES[name.removesuffix("_deg")])
    remedy = (
        "name columns t (with its zone) or t_s, and x_m, y_m, z_m or lat, lon, alt_m; see: fieldkit docs positions"
    )
    if len(times) != 1:
        raise EvidenceError(f"has {len(times)} columns of times", where=where, remedy=remedy)
    if {"x", "y"} <= found.keys() and not found.keys() & _DEGREES.keys():
        return _Columns(LOCAL, times[0], (found["x"], found["y"], found.get("z")))
    if {"lat", "lon"} <= found.keys() and not found.keys() & set(_AXES):
        return _Columns(WGS84, times[0], (found["lat"], found["lon"], found.get("alt")))
    raise EvidenceError("does not name its places", where=where, remedy=remedy)


def _time_ns(name: str, text: str, where: str) -> int:
    """Return a time in nanoseconds since 1970 UTC."""
    no_time = EvidenceError(f"{text[:40]!r} is no time", where=where, remedy="2026-11-22T10:00:00.5Z")
    if name != "t":
        if not _COUNTED.fullmatch(text):  # nor 1.7e9, of which whoever wrote it left digits out
            raise no_time
        return round(Decimal(text) * _NS_PER[name])  # a float has no room for nanoseconds since 1970
    try:
        read = datetime.fromisoformat(text)
    except ValueError:
        raise no_time from None
    if read.tzinfo is None:
        raise EvidenceError(f"{text[:40]!r} has no time zone", where=where, remedy="end it in Z, or in +02:00")
    return utc_ns(read)


def utc_ns(moment: datetime) -> int:
    """Return a moment that has a zone in nanoseconds since 1970 UTC, exactly."""
    whole = moment.replace(microsecond=0)
    return round(whole.timestamp()) * 10**9 + moment.microsecond * 1000
