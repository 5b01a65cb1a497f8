"""Trajectories of robots: linear interpolation between samples of their positions, except in gaps."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Floats, Ints
from fieldkit.measure.evidence.track import Separation

SPEED_SPAN_NS: Final = 200_000_000
"""Shortest time over which a speed is computed, unless the positions cover less. Over a shorter time, noise of the
positions would appear as speed."""

_ALWAYS: Final = np.array([0, 2**62])
"""Times of a trajectory that covers every time span, in ns since 1970."""
_NEGLIGIBLE_PATH: Final = 1e-6
"""A path is regarded as a point if it is shorter than this share of its distance from the origin, or of 1 mm."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions of a robot over time, by one clock.

    Attributes:
        times_ns: Times, increasing. Shape (n,).
        places_m: Positions in metres. Shape (n, 3).
        gap_ns: Longest time between two samples over which positions are interpolated. In longer gaps, the position
            is unknown.
    """

    times_ns: Ints
    places_m: Floats
    gap_ns: int

    def at_m(self, times_ns: Ints) -> Floats:
        """Return interpolated positions, shape (m, 3), at times between the first and the last sample, shape (m,)."""
        base_ns = int(times_ns[0])  # a float cannot represent nanoseconds since 1970
        relative_ns, sample_ns = times_ns - base_ns, self.times_ns - base_ns
        return np.column_stack([np.interp(relative_ns, sample_ns, axis) for axis in self.places_m.T])

    def coverage_problem(self, start_ns: int, end_ns: int) -> str | None:
        """Return the reason why the trajectory does not cover a time span, or None if it does.

        The reason has no subject: the caller prepends one, such as "the positions of the sender".
        """
        first, last = int(self.times_ns[0]), int(self.times_ns[-1])
        if start_ns < first:
            return f"begin {(first - start_ns) / 1e9:.1f} s too late"
        if end_ns > last:
            return f"end {(end_ns - last) / 1e9:.1f} s too early"
        begin = int(np.searchsorted(self.times_ns, start_ns, side="right")) - 1
        end = int(np.searchsorted(self.times_ns, end_ns, side="left"))
        widest_ns = int(np.diff(self.times_ns[begin : end + 1]).max(initial=0))
        if widest_ns > self.gap_ns:
            return f"have a gap of {widest_ns / 1e9:.1f} s, but at most {self.gap_ns / 1e9:g} s are allowed"
        return None


def stationary(place_m: Floats) -> Trajectory:
    """Return the trajectory of a robot that does not move from `place_m`, shape (3,)."""
    return Trajectory(_ALWAYS, np.array([place_m, place_m]), gap_ns=2**62)


def separation_between(source: Trajectory, destination: Trajectory, start_ns: int, end_ns: int) -> Separation:
    """Return the distances and speeds of two robots during a time span that both trajectories cover.

    Args:
        source: The sender, whose speed over the ground is also returned.
        destination: The receiver.
        start_ns: Start of the time span.
        end_ns: End of the time span.
    """
    sample_times_ns = np.concatenate((source.times_ns, destination.times_ns))
    inner_times_ns = sample_times_ns[(sample_times_ns > start_ns) & (sample_times_ns < end_ns)]
    times_ns = np.unique(np.concatenate(((start_ns, end_ns), inner_times_ns)))
    between_m = destination.at_m(times_ns) - source.at_m(times_ns)
    distances_m = np.linalg.norm(between_m, axis=1)
    lengths_ns = np.diff(times_ns)
    pieces = list(pairwise(between_m))
    means_m = [_mean_m(*piece) for piece in pieces]
    has_length = len(pieces) > 0
    return Separation(
        distance_start_m=float(distances_m[0]),
        distance_min_m=float(min((_nearest_m(*piece) for piece in pieces), default=distances_m[0])),
        distance_mean_m=float(np.average(means_m, weights=lengths_ns)) if has_length else float(distances_m[0]),
        distance_max_m=float(distances_m.max()),
        relative_speed_m_s=_speed_m_s(source, destination, start_ns, end_ns),
        sender_speed_m_s=_speed_m_s(source, None, start_ns, end_ns),
    )


def distances_m(source: Trajectory, destination: Trajectory) -> tuple[Ints, Floats]:
    """Return all sample times that both trajectories cover, and the distances at these times; both of shape (n,)."""
    start_ns = max(int(source.times_ns[0]), int(destination.times_ns[0]))
    end_ns = min(int(source.times_ns[-1]), int(destination.times_ns[-1]))
    times_ns = np.unique(np.concatenate((source.times_ns, destination.times_ns)))
    times_ns = times_ns[(times_ns >= start_ns) & (times_ns <= end_ns)]
    if not len(times_ns):
        return times_ns, np.empty(0)
    return times_ns, np.linalg.norm(destination.at_m(times_ns) - source.at_m(times_ns), axis=1)


def _nearest_m(begin: Floats, end: Floats) -> float:
    """Return the smallest distance between a straight path and the origin."""
    path = end - begin
    square = float(path @ path)
    share = min(max(-float(begin @ path) / square, 0.0), 1.0) if square > 0 else 0.0
    return float(np.linalg.norm(begin + share * path))


def _mean_m(begin: Floats, end: Floats) -> float:
    """Return the mean distance from the origin along a straight path at constant speed.

    It is the integral of sqrt(w^2 + h^2) along the path, divided by the length of the path. h is the distance of the
    point that is nearest to the origin, and w is the position along the path relative to this point.
    """
    path = end - begin
    length_m, first_m = float(np.linalg.norm(path)), float(np.linalg.norm(begin))
    if length_m <= _NEGLIGIBLE_PATH * max(first_m, 1e-3):
        return (first_m + float(np.linalg.norm(end))) / 2
    start_m = float(begin @ path) / length_m
    offset_m = float(np.linalg.norm(begin - start_m * path / length_m))

    def integral(at_m: float) -> float:
        log_term = offset_m**2 * np.arcsinh(at_m / offset_m) if offset_m > 0 else 0.0
        return float(at_m * np.hypot(at_m, offset_m) + log_term) / 2

    return (integral(start_m + length_m) - integral(start_m)) / length_m


def _speed_m_s(robot: Trajectory, reference: Trajectory | None, start_ns: int, end_ns: int) -> float:
    """Return the mean speed of a robot relative to `reference` or, if it is None, to the ground.

    A time span shorter than `SPEED_SPAN_NS` is extended to this length, as far as the trajectories cover it. The
    speed is 0 if the time span then still has no length.
    """
    missing_ns = max(SPEED_SPAN_NS - (end_ns - start_ns), 0) // 2
    trajectories = [trajectory for trajectory in (robot, reference) if trajectory is not None]
    first_ns = max(start_ns - missing_ns, *(int(trajectory.times_ns[0]) for trajectory in trajectories))
    last_ns = min(end_ns + missing_ns, *(int(trajectory.times_ns[-1]) for trajectory in trajectories))
    if last_ns <= first_ns:
        return 0.0
    pieces = max((last_ns - first_ns) // SPEED_SPAN_NS, 1)
    times_ns = first_ns + (np.arange(pieces + 1) * (last_ns - first_ns)) // pieces
    places_m = robot.at_m(times_ns) - (0.0 if reference is None else reference.at_m(times_ns))
    path_m = float(np.linalg.norm(np.diff(places_m, axis=0), axis=1).sum())
    return path_m / ((last_ns - first_ns) / 1e9)
