"""Trajectories of robots through samples of where they were: straight between two of them, and nowhere in a gap."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Floats, Ints
from fieldkit.measure.evidence.track import Apart

SPEED_SPAN_NS: Final = 200_000_000
"""Speeds are those of ways between places so far apart in time: between nearer ones noise would pass for speed."""

_ALWAYS: Final = np.array([0, 2**62])
_STRAIGHT: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where a robot was, by one clock.

    Attributes:
        times_ns: When, rising. Shape (n,).
        places_m: Where, in metres. Shape (n, 3).
        gap_ns: Between two samples further apart nobody knows where it was.
    """

    times_ns: Ints
    places_m: Floats
    gap_ns: int

    def at_m(self, times_ns: Ints) -> Floats:
        """Return where it was at times from its first sample to its last. Shapes (m,) and (m, 3)."""
        base_ns = int(times_ns[0])  # a float has no room for nanoseconds since 1970
        at, known = times_ns - base_ns, self.times_ns - base_ns
        return np.column_stack([np.interp(at, known, axis) for axis in self.places_m.T])

    def unknown(self, start_ns: int, end_ns: int) -> str | None:
        """Return why nobody knows where it was all the time from one moment to another; None where somebody does."""
        first, last = int(self.times_ns[0]), int(self.times_ns[-1])
        if start_ns < first:
            return f"begins {(first - start_ns) / 1e9:.1f} s too late"
        if end_ns > last:
            return f"ends {(end_ns - last) / 1e9:.1f} s too early"
        begin = int(np.searchsorted(self.times_ns, start_ns, side="right")) - 1
        end = int(np.searchsorted(self.times_ns, end_ns, side="left"))
        widest_ns = int(np.diff(self.times_ns[begin : end + 1]).max(initial=0))
        if widest_ns > self.gap_ns:
            return f"has a gap of {widest_ns / 1e9:.1f} s, and {self.gap_ns / 1e9:g} s are allowed"
        return None


def standing(place_m: Floats) -> Trajectory:
    """Return the trajectory of a robot that stays in its place. Shape (3,)."""
    return Trajectory(_ALWAYS, np.array([place_m, place_m]), gap_ns=2**62)


def apart(source: Trajectory, destination: Trajectory, start_ns: int, end_ns: int) -> Apart:
    """Return how far two robots were apart from one moment to another, at all of which both are known.

    Args:
        source: The one that sends, whose speed is told by itself.
        destination: The other.
        start_ns: From when.
        end_ns: Until when.
    """
    knots_ns = np.concatenate((source.times_ns, destination.times_ns))
    inside_ns = knots_ns[(knots_ns > start_ns) & (knots_ns < end_ns)]
    times_ns = np.unique(np.concatenate(((start_ns, end_ns), inside_ns)))
    between_m = destination.at_m(times_ns) - source.at_m(times_ns)
    distances_m = np.linalg.norm(between_m, axis=1)
    lengths_ns = np.diff(times_ns)
    pieces = list(pairwise(between_m))
    means_m = [_mean_m(*piece) for piece in pieces]
    whole = len(pieces) > 0
    return Apart(
        distance_start_m=float(distances_m[0]),
        distance_min_m=float(min((_nearest_m(*piece) for piece in pieces), default=distances_m[0])),
        distance_mean_m=float(np.average(means_m, weights=lengths_ns)) if whole else float(distances_m[0]),
        distance_max_m=float(distances_m.max()),
        relative_speed_m_s=_speed_m_s(source, destination, start_ns, end_ns),
        sender_speed_m_s=_speed_m_s(source, None, start_ns, end_ns),
    )


def distances_m(source: Trajectory, destination: Trajectory) -> tuple[Ints, Floats]:
    """Return the distance at each sample of either while both are known, and when; shape (n,) each."""
    start_ns = max(int(source.times_ns[0]), int(destination.times_ns[0]))
    end_ns = min(int(source.times_ns[-1]), int(destination.times_ns[-1]))
    times_ns = np.unique(np.concatenate((source.times_ns, destination.times_ns)))
    times_ns = times_ns[(times_ns >= start_ns) & (times_ns <= end_ns)]
    if not len(times_ns):
        return times_ns, np.empty(0)
    return times_ns, np.linalg.norm(destination.at_m(times_ns) - source.at_m(times_ns), axis=1)


def _nearest_m(begin: Floats, end: Floats) -> float:
    """Return how near to the origin the straight way from one place to another comes."""
    way = end - begin
    square = float(way @ way)
    share = min(max(-float(begin @ way) / square, 0.0), 1.0) if square > 0 else 0.0
    return float(np.linalg.norm(begin + share * way))


def _mean_m(begin: Floats, end: Floats) -> float:
    """Return the mean distance from the origin along the straight way from one place to another, at constant speed.

    The integral of sqrt(w^2 + h^2), w along the way from its point nearest to the origin, which is h away.
    """
    way = end - begin
    length_m, first_m = float(np.linalg.norm(way)), float(np.linalg.norm(begin))
    if length_m <= _STRAIGHT * max(first_m, 1e-3):
        return (first_m + float(np.linalg.norm(end))) / 2
    along_m = float(begin @ way) / length_m
    off_m = float(np.linalg.norm(begin - along_m * way / length_m))

    def integral(at_m: float) -> float:
        bent = off_m**2 * np.arcsinh(at_m / off_m) if off_m > 0 else 0.0
        return float(at_m * np.hypot(at_m, off_m) + bent) / 2

    return (integral(along_m + length_m) - integral(along_m)) / length_m


def _speed_m_s(one: Trajectory, other: Trajectory | None, start_ns: int, end_ns: int) -> float:
    """Return the mean speed of a robot, against another or the ground, over `SPEED_SPAN_NS` or more."""
    missing_ns = max(SPEED_SPAN_NS - (end_ns - start_ns), 0) // 2
    known = [trajectory for trajectory in (one, other) if trajectory is not None]
    first_ns = max(start_ns - missing_ns, *(int(trajectory.times_ns[0]) for trajectory in known))
    last_ns = min(end_ns + missing_ns, *(int(trajectory.times_ns[-1]) for trajectory in known))
    if last_ns <= first_ns:
        return 0.0
    pieces = max((last_ns - first_ns) // SPEED_SPAN_NS, 1)
    times_ns = first_ns + (np.arange(pieces + 1) * (last_ns - first_ns)) // pieces
    places_m = one.at_m(times_ns) - (0.0 if other is None else other.at_m(times_ns))
    way_m = float(np.linalg.norm(np.diff(places_m, axis=0), axis=1).sum())
    return way_m / ((last_ns - first_ns) / 1e9)
