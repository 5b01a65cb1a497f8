"""Estimate of the offset between the receiver's and the sender's clock, from packets in both captures.

No packet arrives before it was sent. The offset is therefore at most the apparent delay of any packet to the
receiver, and at least the negative apparent delay of any packet from the receiver. If the drift is constant, the
offset is a straight line over time, and every line below all upper bounds and above all lower bounds is possible
(Duda et al., "Estimating global time in distributed systems", ICDCS 1987; the convex hulls are as in Moon, Skelly and
Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999). The captures contain
no more information: the division of a round trip into its two directions cannot be observed (Paxson, "On calibrating
measurements of packet transit times", SIGMETRICS 1998).

A single wrong time stamp can exclude the true line. A line is therefore considered possible if it violates the bound
of at most one packet. The true line is then possible even if one time stamp is wrong by any amount. This is the
intersection algorithm of Marzullo and Owicki ("Maintaining the time in a distributed system", PODC 1983; RFC 5905,
section 11.2.1) with at most one faulty source, where each packet is a source. The possible lines are the lines in the
polygons that result if any one packet is omitted; only packets on the convex hulls change the polygon. No smaller set
of lines is sufficient, because each of these lines can be the true one if the time stamp of the omitted packet is
wrong.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from fieldkit.measure.captures.arrays import Floats, Ints, Table

MAX_SKEW: Final = 500e-6
"""Largest plausible skew in seconds per second. It is the largest skew that NTP can correct through the kernel
(adjtimex(2)); a clock with a larger skew is considered broken.
"""

QUARTZ_SKEW: Final = 100e-6
"""Usual upper limit of the skew between two quartz clocks. If the range of possible skews is wider than this, the
packets are not sufficient to estimate the skew.
"""

STAMP_S: Final = 1e-6
"""Maximum error of the difference of two times: tcpdump truncates times to microseconds."""

_HULL_POINTS: Final = 1024
"""Maximum number of points from which a convex hull is computed."""


@dataclass(frozen=True, eq=False)
class StampPairs(Table):
    """Times of packets of one direction that are in both captures, in any order.

    Attributes:
        sender_ns: Time of capture at the transfer's sender, by its clock; the packet may go in either direction.
        receiver_ns: Time of capture at the transfer's receiver, by its clock.
    """

    sender_ns: Ints
    receiver_ns: Ints


@dataclass(frozen=True, eq=False)
class Clocks:
    """Offset of the receiver's clock from the sender's over time: the estimated line and the range of possible lines.

    Offsets are relative to `base_ns`, so that they are precise even if the clocks differ by decades. Times are in
    seconds relative to `middle_ns`. If a direction has a single packet, no other packet confirms its time, and the
    error is infinite.

    Attributes:
        middle_ns: Middle of the packets' times by the receiver's clock.
        base_ns: Integer part of the offset.
        offset_s: Estimate of the remaining offset at `middle_ns`.
        skew: Estimate of the skew: relative rate of the receiver's clock minus 1, in seconds per second.
        skews: Skews at the corners of the polygons of possible lines, ascending. Shape (k,).
        lowest_s: Lowest possible offset at `middle_ns` for each of these skews. Shape (k,).
        highest_s: Highest possible offset at `middle_ns` for each of these skews. Shape (k,).
    """

    middle_ns: int
    base_ns: int
    offset_s: float
    skew: float
    skews: Floats
    lowest_s: Floats
    highest_s: Floats

    @property
    def skew_error(self) -> float:
        """Maximum error of `skew`."""
        return float(max(self.skews[-1] - self.skew, self.skew - self.skews[0]))

    def offset_at_s(self, receiver_ns: Ints) -> Floats:
        """Return the offset relative to `base_ns` at times of the receiver's clock."""
        return self.offset_s + self.skew * self._elapsed_s(receiver_ns)

    def delays_s(self, sender_ns: Ints, receiver_ns: Ints) -> Floats:
        """Return the one-way delays of packets from sender to receiver, given the times by each robot's clock."""
        return (receiver_ns - sender_ns - self.base_ns) / 1e9 - self.offset_at_s(receiver_ns)

    def error_s(self, receiver_ns: Ints) -> float:
        """Return the maximum error of the offset at these times of the receiver's clock."""
        # The possible range widens with the distance from the middle, so the error is largest at the ends.
        ends = np.array((receiver_ns.min(), receiver_ns.max()))
        best, drift = self.offset_at_s(ends), np.outer(self.skews, self._elapsed_s(ends))
        above, below = self.highest_s[:, None] + drift - best, best - self.lowest_s[:, None] - drift
        return float(max(above.max(), below.max()))

    def _elapsed_s(self, receiver_ns: Ints) -> Floats:
        elapsed: Floats = (receiver_ns - self.middle_ns) / 1e9
        return elapsed


def estimate(forward: StampPairs, reverse: StampPairs) -> Clocks | None:
    """Return the offset between the clocks.

    Return None if no line fits all packets, because a clock was set or the skew is larger than `MAX_SKEW`.

    The estimated skew maximizes the shortest round-trip time, computed without the fastest packet of each direction.
    If both directions have undelayed packets at the start and at the end, any other skew gives a shorter time. If
    several skews are equally good, the one closest to 0 is used. If the range of possible skews is wider than
    `QUARTZ_SKEW`, the possible skew closest to 0 is used. The offset is the middle of the range that is possible with
    this skew.

    Args:
        forward: Packets from sender to receiver; at least one. Each frame may be in one pair only.
        reverse: Packets from receiver to sender; at least one. Each frame may be in one pair only.
    """
    times = np.concatenate((forward.receiver_ns, reverse.receiver_ns))
    middle_ns = (int(times.min()) + int(times.max())) // 2
    base_ns = int(forward.receiver_ns[0] - forward.sender_ns[0])
    above, below = (_points(pairs, middle_ns, base_ns) for pairs in (forward, reverse))
    # A ceiling is the lower hull of the offset's upper bounds. A floor is the lower hull of the negated lower bounds.
    # The first hull of each list contains all packets; each later hull omits one packet.
    ceilings, floors = _Hull.of_all_but_one(*above), _Hull.of_all_but_one(below[0], -below[1])
    ceiling, floor = ceilings[0], floors[0]
    if _polygon(ceiling, floor) is None:
        return None
    hulls = [(hull, floor) for hull in ceilings] + [(ceiling, hull) for hull in floors[1:]]
    polygons = [polygon for pair in hulls if (polygon := _polygon(*pair)) is not None]
    skews, lowest_s, highest_s = np.concatenate(polygons, axis=1)
    order = np.argsort(skews, kind="stable")
    skew = _best_skew(ceilings, floors, float(skews.min()), float(skews.max()))
    ends = _range_without_fastest(ceilings, floors, np.array([skew]))
    if not np.isfinite(ends).all():  # a direction has a single packet
        ends = _range(ceiling, floor, np.array([skew]))
    offset_s = float(ends[0][0] + ends[1][0]) / 2
    return Clocks(middle_ns, base_ns, offset_s, skew, skews[order], lowest_s[order], highest_s[order])


def _best_skew(ceilings: Sequence["_Hull"], floors: Sequence["_Hull"], lowest: float, highest: float) -> float:
    """Return the estimated skew.

    Args:
        ceilings: Hulls of packets from sender to receiver, from `_Hull.of_all_but_one`.
        floors: Hulls of packets from receiver to sender.
        lowest: Lowest possible skew.
        highest: Highest possible skew.
    """
    slopes = np.concatenate([hull.slopes() for hull in ceilings] + [-hull.slopes() for hull in floors])
    skews = np.clip(np.append(slopes, (0.0, -MAX_SKEW, MAX_SKEW)), lowest, highest)
    lowest_s, highest_s = _range_without_fastest(ceilings, floors, skews)
    width_s = highest_s - lowest_s
    best = skews[width_s >= width_s.max() - STAMP_S]
    skew = float(best[np.abs(best).argmin()])
    return float(np.clip(0.0, lowest, highest)) if max(highest - skew, skew - lowest) > QUARTZ_SKEW else skew


def _range(ceiling: "_Hull", floor: "_Hull", skews: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and the highest offset that the hulls permit with each skew."""
    return -floor.intercepts(-skews) - STAMP_S, ceiling.intercepts(skews) + STAMP_S


def _range_without_fastest(
    ceilings: Sequence["_Hull"], floors: Sequence["_Hull"], skews: Floats
) -> tuple[Floats, Floats]:
    """Return the lowest and the highest offset with each skew if the fastest packet of each direction is omitted."""
    return (
        np.min([_range(ceilings[0], floor, skews)[0] for floor in floors], axis=0),
        np.max([_range(ceiling, floors[0], skews)[1] for ceiling in ceilings], axis=0),
    )


def _polygon(ceiling: "_Hull", floor: "_Hull") -> Floats | None:
    """Return the corners of the polygon of lines between two hulls, or None if there is no such line.

    The rows are skews, lowest offsets and highest offsets.
    """
    slopes = np.concatenate(((-MAX_SKEW, MAX_SKEW), ceiling.slopes(), -floor.slopes()))
    skews = np.unique(np.clip(slopes, -MAX_SKEW, MAX_SKEW))
    lowest_s, highest_s = _range(ceiling, floor, skews)
    width_s = highest_s - lowest_s
    if width_s.max() < 0:
        return None
    first, last = _possible_skews(skews, width_s)
    corners = np.concatenate(((first,), skews[(skews > first) & (skews < last)], (last,)))
    return np.stack((corners, *_range(ceiling, floor, corners)))


def _points(pairs: StampPairs, middle_ns: int, base_ns: int) -> tuple[Floats, Floats]:
    """Return times in seconds and the apparent offsets of the receiver's clock at these times in seconds."""
    return (pairs.receiver_ns - middle_ns) / 1e9, (pairs.receiver_ns - pairs.sender_ns - base_ns) / 1e9


def _possible_skews(skews: Floats, width_s: Floats) -> tuple[float, float]:
    """Return the range of skews in which `width_s` is not negative; it is concave, and linear between the skews."""
    # `np.interp` needs ascending widths, so the skews after the peak are in reversed order.
    peak = int(width_s.argmax())
    rising, falling = slice(None, peak + 1), slice(None, peak - 1 if peak else None, -1)
    return (
        float(np.interp(0.0, width_s[rising], skews[rising])),
        float(np.interp(0.0, width_s[falling], skews[falling])),
    )


@dataclass(frozen=True, eq=False)
class _Hull:
    """Lower convex hull of points, or of a selection of them. Without points, every line is below the hull."""

    x: Floats
    y: Floats

    @classmethod
    def of_all_but_one(cls, x: Floats, y: Floats) -> list[Self]:
        """Return the hull of at most `_HULL_POINTS` points, then a hull for each of its points that omits this point.

        The points are the lowest points of groups of neighbours. Omitting the other points can only raise the hull,
        so no possible line is excluded.
        """
        size = -(-len(x) // _HULL_POINTS)
        groups = np.append(y, np.full(-len(y) % size, np.inf)).reshape(-1, size)
        lowest = groups.argmin(axis=1) + np.arange(len(groups)) * size
        points = sorted(zip(x[lowest].tolist(), y[lowest].tolist(), strict=True))
        outer = _lower_hull(points)
        on_hull = set(outer)
        # If a point of this hull is omitted, only points of the hull of the inner points can be added to the hull.
        inner_points = [point for index, point in enumerate(points) if index not in on_hull]
        inner_hull = [inner_points[index] for index in _lower_hull(inner_points)]
        hulls = [[points[index] for index in outer]]
        for omitted in outer:
            other_points = sorted([points[index] for index in outer if index != omitted] + inner_hull)
            hulls.append([other_points[index] for index in _lower_hull(other_points)])
        return [cls(*np.array(hull).reshape(-1, 2).T) for hull in hulls]

    def slopes(self) -> Floats:
        """Return the slope of each edge."""
        slopes: Floats = np.diff(self.y) / np.diff(self.x)
        return slopes

    def intercepts(self, slopes: Floats) -> Floats:
        """Return the intercepts at x = 0 of the lines that touch the hull from below and have these slopes."""
        intercepts: Floats = (self.y[:, None] - np.outer(self.x, slopes)).min(axis=0, initial=np.inf)
        return intercepts


def _lower_hull(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points on the lower convex hull of points that are in ascending order."""
    hull: list[int] = []
    for index, point in enumerate(points):
        if hull and point[0] == points[hull[-1]][0]:
            continue
        while len(hull) > 1 and _is_above_chord(points[hull[-2]], points[hull[-1]], point):
            hull.pop()
        hull.append(index)
    return hull


def _is_above_chord(first: tuple[float, float], second: tuple[float, float], third: tuple[float, float]) -> bool:
    return (second[1] - first[1]) * (third[0] - second[0]) >= (third[1] - second[1]) * (second[0] - first[0])
