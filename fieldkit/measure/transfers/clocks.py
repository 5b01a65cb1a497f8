"""Estimate how far the receiver's clock is ahead of the sender's, from packets that both captures hold.

No packet arrives before it was sent. So the receiver's clock is ahead by at most what any packet to it seems to take,
and by at least the time by which any packet from it seems to arrive too early. Clocks that drift apart evenly stay on
a straight line over time, and every line with all of the former above it and all of the latter below is possible
(Duda et al., "Estimating global time in distributed systems", ICDCS 1987; the hulls are those of Moon, Skelly and
Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999). The captures tell
nothing more: how a round trip is divided between its two ways cannot be seen (Paxson, "On calibrating measurements of
packet transit times", SIGMETRICS 1998).
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from fieldkit.measure.captures.arrays import Floats, Ints, Table

MAX_SKEW: Final = 500e-6
"""Beyond it clocks count as broken, in seconds per second: what a kernel lets NTP correct (adjtimex(2))."""

QUARTZ_SKEW: Final = 100e-6
"""Two quartz clocks differ by less, as a rule: packets that leave more open than that tell nothing of their drift."""

STAMP_S: Final = 1e-6
"""tcpdump cuts times off to microseconds: the difference of two is wrong by up to this."""

_HULL_POINTS: Final = 1024


@dataclass(frozen=True, eq=False)
class StampPairs(Table):
    """Packets of one direction that both captures hold, in any order.

    Attributes:
        sender_ns: When the transfer's sender captured each, by its clock, be it the one that sent it or not.
        receiver_ns: When the transfer's receiver did, by its own.
    """

    sender_ns: Ints
    receiver_ns: Ints


@dataclass(frozen=True, eq=False)
class Clocks:
    """The receiver's clock against the sender's: a straight line over time, and all others that are possible.

    Offsets count from `base_ns`, so that clocks decades apart lose no digit; times are seconds from `middle_ns`.

    Attributes:
        middle_ns: The middle of the packets' times, by the receiver's clock.
        base_ns: Part of the offset, as a whole number.
        offset_s: The rest of it in the middle, best estimate.
        skew: How much faster the receiver's clock goes, in seconds per second, best estimate.
        skews: The corners of what is possible, by rising skew. Shape (k,).
        lowest_s: The least offset in the middle under each of these. Shape (k,).
        highest_s: The greatest. Shape (k,).
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
        """The most that `skew` can be wrong."""
        return float(max(self.skews[-1] - self.skew, self.skew - self.skews[0]))

    def ahead_s(self, receiver_ns: Ints) -> Floats:
        """Return the offset beyond `base_ns` at times of the receiver's clock."""
        return self.offset_s + self.skew * self._elapsed_s(receiver_ns)

    def delays_s(self, sender_ns: Ints, receiver_ns: Ints) -> Floats:
        """Return how long packets were on the way from sender to receiver, each by its clock."""
        return (receiver_ns - sender_ns - self.base_ns) / 1e9 - self.ahead_s(receiver_ns)

    def error_s(self, receiver_ns: Ints) -> float:
        """Return the most that the offset can be wrong at any of these times of the receiver's clock."""
        # What is possible spreads from the middle on, so the ends are the worst.
        ends = np.array((receiver_ns.min(), receiver_ns.max()))
        best, drift = self.ahead_s(ends), np.outer(self.skews, self._elapsed_s(ends))
        above, below = self.highest_s[:, None] + drift - best, best - self.lowest_s[:, None] - drift
        return float(max(above.max(), below.max()))

    def _elapsed_s(self, receiver_ns: Ints) -> Floats:
        elapsed: Floats = (receiver_ns - self.middle_ns) / 1e9
        return elapsed


def estimate(forward: StampPairs, reverse: StampPairs) -> Clocks | None:
    """Return the receiver's clock against the sender's; None when no line fits, since a clock was set meanwhile.

    The skew is the one under which the fastest round trip is longest: where both ways were free early and late, any
    other makes one of them look faster than it was. Of equally good ones it is the smallest; and where the packets
    leave more open than `QUARTZ_SKEW`, the smallest that is possible. The offset is the middle of what is possible
    under it.

    Args:
        forward: Packets from sender to receiver, at least one.
        reverse: Packets from receiver to sender, at least one.
    """
    times = np.concatenate((forward.receiver_ns, reverse.receiver_ns))
    middle_ns = (int(times.min()) + int(times.max())) // 2
    base_ns = int(forward.receiver_ns[0] - forward.sender_ns[0])
    above, below = (_points(seen, middle_ns, base_ns) for seen in (forward, reverse))
    ceiling, floor = _Hull.under(*above), _Hull.under(below[0], -below[1])

    def bounds(skews: Floats) -> tuple[Floats, Floats]:
        return -floor.lift(-skews) - STAMP_S, ceiling.lift(skews) + STAMP_S

    bends = np.concatenate(((-MAX_SKEW, MAX_SKEW), ceiling.slopes(), -floor.slopes()))
    skews = np.unique(np.clip(bends, -MAX_SKEW, MAX_SKEW))
    lowest, highest = bounds(skews)
    width = highest - lowest
    if width.max() < 0:
        return None
    first, last = _reaching(skews, width, 0.0)
    corners = np.concatenate(((first,), skews[(skews > first) & (skews < last)], (last,)))
    skew = float(np.clip(0.0, *_reaching(skews, width, float(width.max()) - STAMP_S)))
    if max(last - skew, skew - first) > QUARTZ_SKEW:
        skew = float(np.clip(0.0, first, last))
    (low,), (high,) = bounds(np.array([skew]))
    return Clocks(middle_ns, base_ns, float(low + high) / 2, skew, corners, *bounds(corners))


def _points(seen: StampPairs, middle_ns: int, base_ns: int) -> tuple[Floats, Floats]:
    """Return times and how far the receiver's clock seems to be ahead."""
    return (seen.receiver_ns - middle_ns) / 1e9, (seen.receiver_ns - seen.sender_ns - base_ns) / 1e9


def _reaching(skews: Floats, width: Floats, least: float) -> tuple[float, float]:
    """Return the range of skews in which the width, concave and straight between `skews`, is `least` or more."""
    top = int(width.argmax())
    rising, falling = slice(None, top + 1), slice(None, top - 1 if top else None, -1)
    return (
        float(np.interp(least, width[rising], skews[rising])),
        float(np.interp(least, width[falling], skews[falling])),
    )


@dataclass(frozen=True, eq=False)
class _Hull:
    """The lower convex hull of points, or of enough of them."""

    x: Floats
    y: Floats

    @classmethod
    def under(cls, x: Floats, y: Floats) -> Self:
        """Return the hull of points, at most `_HULL_POINTS` of them: the lowest of each run of neighbours.

        What is left out makes the hull lower nowhere, so that it excludes no line that is possible.
        """
        size = -(-len(x) // _HULL_POINTS)
        runs = np.append(y, np.full(-len(y) % size, np.inf)).reshape(-1, size)
        lowest = runs.argmin(axis=1) + np.arange(len(runs)) * size
        order = lowest[np.lexsort((y[lowest], x[lowest]))]
        kept: list[tuple[float, float]] = []
        for point in zip(x[order].tolist(), y[order].tolist(), strict=True):
            if kept and point[0] == kept[-1][0]:
                continue
            while len(kept) > 1 and _bends_down(kept[-2], kept[-1], point):
                kept.pop()
            kept.append(point)
        return cls(*np.array(kept).T)

    def slopes(self) -> Floats:
        """Return the slope of each edge."""
        slopes: Floats = np.diff(self.y) / np.diff(self.x)
        return slopes

    def lift(self, slopes: Floats) -> Floats:
        """Return how high, at x = 0, lines of these slopes are that touch the hull from below."""
        lift: Floats = (self.y[:, None] - np.outer(self.x, slopes)).min(axis=0)
        return lift


def _bends_down(one: tuple[float, float], two: tuple[float, float], three: tuple[float, float]) -> bool:
    return (two[1] - one[1]) * (three[0] - two[0]) >= (three[1] - two[1]) * (two[0] - one[0])
