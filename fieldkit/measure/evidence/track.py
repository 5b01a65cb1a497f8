"""Positions and velocities of robots during a repeat, recorded by a testbed that can measure them (`Oracle.track`).

A CSV line is valid until the next line of the same robot. `east_m`, `north_m` and `up_m` are empty while the robot is
out of range.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.columns import Column, Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role, TrackPoint, Vector
from fieldkit.measure.evidence import reading

FILE: Final = laptop_files.TRACK

_HEADER: Final = "utc_ns,role,east_m,north_m,up_m,east_m_s,north_m_s,up_m_s"
_NUMBER: Final = r"(-?[0-9]{1,9}\.[0-9]{4})"
_POSITION: Final = rf"(?:{_NUMBER},{_NUMBER},{_NUMBER}|,,)"
_LINE: Final = re.compile(rf"([0-9]{{1,19}}),({Role.PATTERN}),{_POSITION},{_NUMBER},{_NUMBER},{_NUMBER}", re.ASCII)


@dataclass(frozen=True)
class Separation:
    """Distance and speeds of two robots during a time span. The name of each column ends with an attribute's name.

    Attributes:
        distance_start_m: Distance at the start; None if a robot had no position at this time.
        distance_min_m: Smallest distance.
        distance_mean_m: Mean distance over the time span.
        distance_max_m: Largest distance.
        relative_speed_m_s: Mean magnitude of the relative velocity over the time span.
        sender_speed_m_s: Mean speed of the sender over the time span.
    """

    distance_start_m: float | None
    distance_min_m: float
    distance_mean_m: float
    distance_max_m: float
    relative_speed_m_s: float
    sender_speed_m_s: float


def text(track: Iterable[TrackPoint]) -> str:
    """Return the file text of a track, with a resolution of 0.1 mm and 0.1 mm/s."""
    return reading.counted_csv_text(_HEADER, map(_format_line, track))


def _format_line(entry: TrackPoint) -> str:
    position = ",," if entry.position_m is None else _format_vector(entry.position_m)
    return f"{entry.utc_ns},{entry.role},{position},{_format_vector(entry.velocity_m_s)}"


def _format_vector(vector: Vector) -> str:
    # Adding 0 converts -0 to 0.
    return ",".join(f"{round(value, 4) + 0.0:.4f}" for value in vector)


def read(path: Path) -> tuple[TrackPoint, ...]:
    """Return the track in a file, in the order of time.

    Raises:
        EvidenceError: The file is missing, truncated, or not a track.
    """
    message = "is not a track of robots"
    track = tuple(map(_parse_line, reading.read_counted_csv(path, _HEADER, _LINE, message)))
    if any(before.utc_ns > after.utc_ns for before, after in pairwise(track)):
        raise EvidenceError(message, where=str(path))
    return track


def _parse_line(match: re.Match[str]) -> TrackPoint:
    utc_ns, role, *numbers = match.groups()
    values = [None if number is None else float(number) for number in numbers]
    return TrackPoint(int(utc_ns), Role(role), _vector(values[:3]), _vector(values[3:]) or (0.0, 0.0, 0.0))


def _vector(values: Sequence[float | None]) -> Vector | None:
    present = [value for value in values if value is not None]
    return (present[0], present[1], present[2]) if len(present) == 3 else None


def distances_m(track: Sequence[TrackPoint], source: Role, destination: Role) -> Iterator[tuple[int, float | None]]:
    """Yield the time in ns and the distance between two robots (None if unknown) for each entry of either robot."""
    for utc_ns, sender, receiver in _joint_states(track, source, destination):
        yield utc_ns, _distance_m(sender, receiver)


def separation_between(
    track: Sequence[TrackPoint], source: Role, destination: Role, start_ns: int, end_ns: int
) -> Separation | None:
    """Return distance and speeds of two robots between two times.

    Times at which a robot has no position are ignored. Return None if the two robots never both have a position, or
    if the track starts after `start_ns`.

    Args:
        track: Positions of the robots.
        source: The sender.
        destination: The receiver.
        start_ns: Start, in ns since 1970 UTC.
        end_ns: End, in ns since 1970 UTC.
    """
    states = list(_joint_states(track, source, destination))
    first = bisect_right([utc_ns for utc_ns, *_ in states], start_ns) - 1
    states_in_span = [state for state in states[max(first, 0) :] if state[0] <= end_ns]
    if first < 0 or not states_in_span:
        return None
    edges_ns = [start_ns, *(utc_ns for utc_ns, *_ in states_in_span[1:]), end_ns]
    pieces = [
        # A piece lasts at least 1 ns, so that the mean is defined if start and end are equal.
        (max(stop_ns - begin_ns, 1), distance_m, sender, receiver)
        for (begin_ns, stop_ns), (_, sender, receiver) in zip(pairwise(edges_ns), states_in_span, strict=True)
        if (distance_m := _distance_m(sender, receiver)) is not None
    ]
    if not pieces:
        return None
    total_ns = sum(ns for ns, *_ in pieces)
    distances = [distance_m for _, distance_m, *_ in pieces]
    return Separation(
        distance_start_m=_distance_m(*states_in_span[0][1:]),
        distance_min_m=min(distances),
        distance_mean_m=sum(ns * distance_m for ns, distance_m, *_ in pieces) / total_ns,
        distance_max_m=max(distances),
        relative_speed_m_s=sum(ns * math.dist(a.velocity_m_s, b.velocity_m_s) for ns, _, a, b in pieces) / total_ns,
        sender_speed_m_s=sum(ns * math.hypot(*a.velocity_m_s) for ns, _, a, _ in pieces) / total_ns,
    )


def _joint_states(
    track: Sequence[TrackPoint], source: Role, destination: Role
) -> Iterator[tuple[int, TrackPoint, TrackPoint]]:
    """Yield the time in ns and the latest entries of both robots for each entry of either robot.

    Entries before both robots have an entry are omitted.
    """
    latest: dict[Role, TrackPoint] = {}
    for entry in track:
        latest[entry.role] = entry
        if entry.role in {source, destination} and source in latest and destination in latest:
            yield entry.utc_ns, latest[source], latest[destination]


def _distance_m(first: TrackPoint, second: TrackPoint) -> float | None:
    if first.position_m is None or second.position_m is None:
        return None
    return math.dist(first.position_m, second.position_m)


def measure(
    track: Sequence[TrackPoint] | None,
    columns: Sequence[Column],
    ends: tuple[Role, Role],
    times_ns: Collection[int],
) -> Measured:
    """Return the columns of distance and speeds of two robots, from the earliest to the latest of several times.

    Args:
        track: Positions of the robots; None if they are unknown.
        columns: The columns, `PREFIX_distance_start_m` and so on.
        ends: Sender and receiver.
        times_ns: The times by a robot's clock, in nanoseconds since 1970 UTC. On testbeds that record positions, this
            is the laptop's clock.
    """
    if track is None:
        return Measured.all_missing(columns, "the positions of the robots are unknown")
    if not len(times_ns):
        return Measured.all_missing(columns, "no packet has a time")
    separation = separation_between(track, *ends, min(times_ns), max(times_ns))
    if separation is None:
        return Measured.all_missing(columns, "a robot had no position")
    values = {column.name: getattr(separation, column.name.partition("_")[2]) for column in columns}
    return Measured.from_optional(values, "a robot had no position at the start")
