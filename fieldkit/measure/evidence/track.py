"""Places and ways of robots during a repeat, noted by a testbed that knows them (`Oracle.track`).

A CSV line holds for its robot until the next of the same robot; `east_m` to `up_m` are empty while nobody heard it.
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
from fieldkit.core.model import Role, Vector, Whereabouts
from fieldkit.measure.evidence import counted_csv

FILE: Final = laptop_files.TRACK

_HEADER: Final = "utc_ns,role,east_m,north_m,up_m,east_m_s,north_m_s,up_m_s"
_NUMBER: Final = r"(-?[0-9]{1,9}\.[0-9]{4})"
_PLACE: Final = rf"(?:{_NUMBER},{_NUMBER},{_NUMBER}|,,)"
_LINE: Final = re.compile(rf"([0-9]{{1,19}}),({Role.PATTERN}),{_PLACE},{_NUMBER},{_NUMBER},{_NUMBER}", re.ASCII)


@dataclass(frozen=True)
class Apart:
    """Distance between two robots during a time, and how they moved; named as the columns of it end.

    Attributes:
        distance_start_m: Distance in the beginning; None where one was nowhere then.
        distance_min_m: Smallest distance.
        distance_mean_m: Mean distance over the time.
        distance_max_m: Largest distance.
        relative_speed_m_s: Mean over the time of the magnitude of their relative velocity.
        sender_speed_m_s: Mean over the time of the speed of the one that sends.
    """

    distance_start_m: float | None
    distance_min_m: float
    distance_mean_m: float
    distance_max_m: float
    relative_speed_m_s: float
    sender_speed_m_s: float


def text(track: Iterable[Whereabouts]) -> str:
    """Return a track as `read` reads it, to 0.1 mm."""
    return counted_csv.text(_HEADER, map(_line, track))


def _line(one: Whereabouts) -> str:
    place = ",," if one.position_m is None else _numbers(one.position_m)
    return f"{one.utc_ns},{one.role},{place},{_numbers(one.velocity_m_s)}"


def _numbers(vector: Vector) -> str:
    # Adding 0 makes a 0 of -0.
    return ",".join(f"{round(value, 4) + 0.0:.4f}" for value in vector)


def read(path: Path) -> tuple[Whereabouts, ...]:
    """Return what stands in the file, in the order of time.

    Raises:
        EvidenceError: It is missing or not whole.
    """
    what = "does not say where robots were"
    track = tuple(map(_parsed, counted_csv.read(path, _HEADER, _LINE, what)))
    if any(before.utc_ns > after.utc_ns for before, after in pairwise(track)):
        raise EvidenceError(what, where=str(path))
    return track


def _parsed(match: re.Match[str]) -> Whereabouts:
    utc_ns, role, *numbers = match.groups()
    values = [None if number is None else float(number) for number in numbers]
    return Whereabouts(int(utc_ns), Role(role), _vector(values[:3]), _vector(values[3:]) or (0.0, 0.0, 0.0))


def _vector(values: Sequence[float | None]) -> Vector | None:
    known = [value for value in values if value is not None]
    return (known[0], known[1], known[2]) if len(known) == 3 else None


def distances_m(track: Sequence[Whereabouts], source: Role, destination: Role) -> Iterator[tuple[int, float | None]]:
    """Yield the distance between two robots, and from when on in ns, as often as one of them moved."""
    for utc_ns, here, there in _together(track, source, destination):
        yield utc_ns, _distance_m(here, there)


def apart(track: Sequence[Whereabouts], source: Role, destination: Role, start_ns: int, end_ns: int) -> Apart | None:
    """Return how far two robots were apart from `start_ns` to `end_ns`, in ns since 1970 UTC.

    Times in which one of them was nowhere do not count; None if there are no others.

    Args:
        track: Where robots were.
        source: The one that sends, whose speed is told by itself.
        destination: The other.
        start_ns: From when.
        end_ns: Until when.
    """
    both = list(_together(track, source, destination))
    first = bisect_right([utc_ns for utc_ns, *_ in both], start_ns) - 1
    held = [item for item in both[max(first, 0) :] if item[0] <= end_ns]
    if first < 0 or not held:
        return None
    edges_ns = [start_ns, *(utc_ns for utc_ns, *_ in held[1:]), end_ns]
    known = [
        # A moment has no length, and still a distance.
        (max(ends_ns - begins_ns, 1), distance_m, here, there)
        for (begins_ns, ends_ns), (_, here, there) in zip(pairwise(edges_ns), held, strict=True)
        if (distance_m := _distance_m(here, there)) is not None
    ]
    if not known:
        return None
    lasted_ns = sum(ns for ns, *_ in known)
    distances = [distance_m for _, distance_m, *_ in known]
    return Apart(
        distance_start_m=_distance_m(*held[0][1:]),
        distance_min_m=min(distances),
        distance_mean_m=sum(ns * distance_m for ns, distance_m, *_ in known) / lasted_ns,
        distance_max_m=max(distances),
        relative_speed_m_s=sum(ns * math.dist(a.velocity_m_s, b.velocity_m_s) for ns, _, a, b in known) / lasted_ns,
        sender_speed_m_s=sum(ns * math.hypot(*a.velocity_m_s) for ns, _, a, _ in known) / lasted_ns,
    )


def _together(
    track: Sequence[Whereabouts], source: Role, destination: Role
) -> Iterator[tuple[int, Whereabouts, Whereabouts]]:
    """Yield where both robots are and from when on, as soon as both are known."""
    now: dict[Role, Whereabouts] = {}
    for change in track:
        now[change.role] = change
        if change.role in {source, destination} and source in now and destination in now:
            yield change.utc_ns, now[source], now[destination]


def _distance_m(here: Whereabouts, there: Whereabouts) -> float | None:
    if here.position_m is None or there.position_m is None:
        return None
    return math.dist(here.position_m, there.position_m)


def measure(
    track: Sequence[Whereabouts] | None,
    declared: Sequence[Column],
    ends: tuple[Role, Role],
    times_ns: Collection[int],
) -> Measured:
    """Return the columns of `declare`: how far two robots were apart from the first of some times to the last.

    Times are by a robot's clock, which is taken for the laptop's: it is, where a testbed knows where robots are.

    Args:
        track: Where robots were; None where nobody knows.
        declared: The columns, `PREFIX_distance_start_m` and so on.
        ends: Who sends and who receives.
        times_ns: The times, nanoseconds since 1970 UTC.
    """
    if track is None:
        return Measured.nothing(declared, "nobody knows where robots are")
    if not len(times_ns):
        return Measured.nothing(declared, "no packet has a time")
    found = apart(track, *ends, min(times_ns), max(times_ns))
    if found is None:
        return Measured.nothing(declared, "a robot was nowhere")
    values = {column.name: getattr(found, column.name.partition("_")[2]) for column in declared}
    return Measured.of(values, "a robot was nowhere in the beginning")
