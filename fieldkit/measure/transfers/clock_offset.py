"""Estimate of the offset between the receiver's and the sender's clock, from packets in both captures.

No packet arrives before it was sent. The offset is therefore at most the apparent delay of any packet to the
receiver, and at least the negative apparent delay of any packet from it. With constant drift the offset is a straight
line over time, and each line is possible that is below all upper bounds and above all lower bounds (Duda et al.,
"Estimating global time in distributed systems", ICDCS 1987; the convex hulls are those of Moon, Skelly and Towsley,
"Estimation and removal of clock skew from network delay measurements", INFOCOM 1999). The captures contain no more
information: the division of a round trip into its two directions is unobservable (Paxson, "On calibrating
measurements of packet transit times", SIGMETRICS 1998).
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from fieldkit.measure.captures.arrays import Floats, Ints, Table

MAX_SKEW: Final = 500e-6
"""Largest plausible skew in seconds per second, which a kernel lets NTP correct (adjtimex(2)); above it a clock is
considered broken."""

QUARTZ_SKEW: Final = 100e-6
"""Usual upper limit of the skew of two quartz clocks. If more is possible, the packets do not determine the skew."""

STAMP_S: Final = 1e-6
"""tcpdump truncates times to microseconds, so the difference of two times is wrong by up to this."""

_HULL_POINTS: Final = 1024


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
    """Offset of the receiver's clock from the sender's over time: the best line, and the range of possible lines.

    Offsets are relative to `base_ns`, which keeps precision if clocks are decades apart. Times are seconds from
    `middle_ns`.

    Attributes:
        middle_ns: Middle of the packets' times by the receiver's clock.
        base_ns: Integer part of the offset.
        offset_s: Best estimate of the remaining offset at `middle_ns`.
        skew: Best estimate of the skew: relative rate of the receiver's clock minus 1, in seconds per second.
        skews: Corners of the possible range of skews, ascending. Shape (k,).
        lowest_s: Lowest possible offset at `middle_ns` for each of these skews. Shape (k,).
        highest_s: Highest possible offset. Shape (k,).
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

    def ahead_s(self, receiver_ns: Ints) -> Floats:
        """Return the offset relative to `base_ns` at times of the receiver's clock."""
        return self.offset_s + self.skew * self._elapsed_s(receiver_ns)

    def delays_s(self, sender_ns: Ints, receiver_ns: Ints) -> Floats:
        """Return the one-way delays of packets from sender to receiver; each time is by the end's own clock."""
        return (receiver_ns - sender_ns - self.base_ns) / 1e9 - self.ahead_s(receiver_ns)

    def error_s(self, receiver_ns: Ints) -> float:
        """Return the maximum error of the offset at these times of the receiver's clock."""
        # The possible range widens with the distance from the middle, so the error is largest at the ends.
        ends = np.array((receiver_ns.min(), receiver_ns.max()))
        best, drift = self.ahead_s(ends), np.outer(self.skews, self._elapsed_s(ends))
        above, below = self.highest_s[:, None] + drift - best, best - self.lowest_s[:, None] - drift
        return float(max(above.max(), below.max()))

    def _elapsed_s(self, receiver_ns: Ints) -> Floats:
        elapsed: Floats = (receiver_ns - self.middle_ns) / 1e9
        return elapsed


def estimate(forward: StampPairs, reverse: StampPairs) -> Clocks | None:
    """Return the offset between the clocks, or None if no line fits because a clock was set.

    The chosen skew maximizes the shortest round-trip time: if both directions were undelayed early and late, any
    other skew shortens one of them. Among equally good skews the smallest is chosen. If the packets leave more than
    `QUARTZ_SKEW` undetermined, the smallest possible skew is chosen. The offset is the middle of the range that is
    possible with this skew.

    Args:
        forward: Packets from sender to receiver, at least one.
        reverse: Packets from receiver to sender, at least one.
    """
    times = np.concatenate((forward.receiver_ns, reverse.receiver_ns))
    middle_ns = (int(times.min()) + int(times.max())) // 2
    base_ns = int(forward.receiver_ns[0] - forward.sender_ns[0])
    above, below = (_points(pairs, middle_ns, base_ns) for pairs in (forward, reverse))
    ceiling, floor = _Hull.below(*above), _Hull.below(below[0], -below[1])

    def bounds(skews: Floats) -> tuple[Floats, Floats]:
        return -floor.intercepts(-skews) - STAMP_S, ceiling.intercepts(skews) + STAMP_S

    slope_changes = np.concatenate(((-MAX_SKEW, MAX_SKEW), ceiling.slopes(), -floor.slopes()))
    skews = np.unique(np.clip(slope_changes, -MAX_SKEW, MAX_SKEW))
    lowest, highest = bounds(skews)
    width = highest - lowest
    if width.max() < 0:
        return None
    first, last = _skew_range(skews, width, 0.0)
    corners = np.concatenate(((first,), skews[(skews > first) & (skews < last)], (last,)))
    skew = float(np.clip(0.0, *_skew_range(skews, width, float(width.max()) - STAMP_S)))
    if max(last - skew, skew - first) > QUARTZ_SKEW:
        skew = float(np.clip(0.0, first, last))
    (low,), (high,) = bounds(np.array([skew]))
    return Clocks(middle_ns, base_ns, float(low + high) / 2, skew, corners, *bounds(corners))


def _points(pairs: StampPairs, middle_ns: int, base_ns: int) -> tuple[Floats, Floats]:
    """Return times and the apparent offset of the receiver's clock."""
    return (pairs.receiver_ns - middle_ns) / 1e9, (pairs.receiver_ns - pairs.sender_ns - base_ns) / 1e9


def _skew_range(skews: Floats, width: Floats, min_width: float) -> tuple[float, float]:
    """Return the range of skews in which `width`, concave and linear between `skews`, is at least `min_width`."""
    top = int(width.argmax())
    rising, falling = slice(None, top + 1), slice(None, top - 1 if top else None, -1)
    return (
        float(np.interp(min_width, width[rising], skews[rising])),
        float(np.interp(min_width, width[falling], skews[falling])),
    )


@dataclass(frozen=True, eq=False)
class _Hull:
    """Lower convex hull of points, or of a sample of them."""

    x: Floats
    y: Floats

    @classmethod
    def below(cls, x: Floats, y: Floats) -> Self:
        """Return the hull of at most `_HULL_POINTS` points: the lowest of each group of neighbours.

        Omitted points can only raise the hull, so no possible line is excluded.
        """
        size = -(-len(x) // _HULL_POINTS)
        runs = np.append(y, np.full(-len(y) % size, np.inf)).reshape(-1, size)
        lowest = runs.argmin(axis=1) + np.arange(len(runs)) * size
        order = lowest[np.lexsort((y[lowest], x[lowest]))]
        hull: list[tuple[float, float]] = []
        for point in zip(x[order].tolist(), y[order].tolist(), strict=True):
            if hull and point[0] == hull[-1][0]:
                continue
            while len(hull) > 1 and _is_above_chord(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        return cls(*np.array(hull).T)

    def slopes(self) -> Floats:
        """Return the slope of each edge."""
        slopes: Floats = np.diff(self.y) / np.diff(self.x)
        return slopes

    def intercepts(self, slopes: Floats) -> Floats:
        """Return the intercepts at x = 0 of the lines with these slopes that touch the hull from below."""
        intercepts: Floats = (self.y[:, None] - np.outer(self.x, slopes)).min(axis=0)
        return intercepts


def _is_above_chord(first: tuple[float, float], second: tuple[float, float], third: tuple[float, float]) -> bool:
    return (second[1] - first[1]) * (third[0] - second[0]) >= (third[1] - second[1]) * (second[0] - first[0])
