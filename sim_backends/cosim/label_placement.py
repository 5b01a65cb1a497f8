"""Places for labels beside their points, so that none covers another: greedy, and the same each time."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

Point = tuple[float, float]
"""In points of the figure, from its lower left corner."""

_AWAY = 1.3
"""Steps by which a label goes further away until there is room, as a factor."""
_MOST_STEPS = 12
_TOUCHED = 10.0
"""What it costs to cover anything at all, in heights of the label that it could be farther away instead."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class LabelBox:
    """A rectangle in points of the figure.

    Attributes:
        left: Its left side.
        bottom: Its lower side.
        width: How wide it is.
        height: How high.
    """

    left: float
    bottom: float
    width: float
    height: float

    def overlap(self, other: "LabelBox") -> float:
        """Return the area that both cover."""
        wide = min(self.left + self.width, other.left + other.width) - max(self.left, other.left)
        high = min(self.bottom + self.height, other.bottom + other.height) - max(self.bottom, other.bottom)
        return max(wide, 0.0) * max(high, 0.0)

    def gap(self, point: Point) -> float:
        """Return how far a point is from it, 0 inside."""
        wide = max(self.left - point[0], 0.0, point[0] - self.left - self.width)
        high = max(self.bottom - point[1], 0.0, point[1] - self.bottom - self.height)
        return math.hypot(wide, high)

    @property
    def area(self) -> float:
        """Its area."""
        return self.width * self.height


def placed(
    at: Sequence[Sequence[Point]], sizes: Sequence[tuple[float, float]], room: LabelBox, taken: Sequence[LabelBox]
) -> list[tuple[Point, LabelBox]]:
    """Return a box for each label and the point that it is beside, over as little of anything else as can be.

    Args:
        at: Points of what each label names, any of which it may be beside.
        sizes: Width and height of each label.
        room: Where labels may be.
        taken: What they must not cover: the points themselves, and lines.
    """
    found: list[tuple[Point, LabelBox]] = []
    for points, size in zip(at, sizes, strict=True):
        covered = [*taken, *(box for _, box in found)]
        candidates = ((point, box) for point in points for box in _around(point, size))
        found.append(min(candidates, key=lambda one: _cost(one[1], one[0], room, covered)))
    return found


def stacked(at: Sequence[Point], sizes: Sequence[tuple[float, float]], left: float, room: LabelBox) -> list[LabelBox]:
    """Return a box for each label, one above the other in the order of their points, as near in height as can be.

    Args:
        at: Where the points are that labels belong to.
        sizes: Width and height of each label.
        left: Where all labels begin.
        room: Where labels may be.
    """
    order = sorted(range(len(at)), key=lambda index: at[index][1])
    bottoms: dict[int, float] = {}
    free = room.bottom
    for index in order:
        bottoms[index] = max(at[index][1] - sizes[index][1] / 2, free)
        free = bottoms[index] + sizes[index][1]
    above = room.bottom + room.height
    for index in reversed(order):  # those that were pushed out of the room go back into it
        bottoms[index] = min(bottoms[index], above - sizes[index][1])
        above = bottoms[index]
    return [LabelBox(left, bottoms[index], *sizes[index]) for index in range(len(at))]


def _around(point: Point, size: tuple[float, float]) -> Iterator[LabelBox]:
    x, y = point
    width, height = size
    away = height * 0.6
    for _ in range(_MOST_STEPS):
        for left, bottom in (
            (x + away, y - height / 2),
            (x - away - width, y - height / 2),
            (x - width / 2, y + away),
            (x - width / 2, y - away - height),
            (x + away * 0.7, y + away * 0.7),
            (x + away * 0.7, y - away * 0.7 - height),
            (x - away * 0.7 - width, y + away * 0.7),
            (x - away * 0.7 - width, y - away * 0.7 - height),
        ):
            yield LabelBox(left, bottom, width, height)
        away *= _AWAY


def _cost(box: LabelBox, point: Point, room: LabelBox, taken: Sequence[LabelBox]) -> float:
    """Return how bad a place is: what it covers weighs most, then what is outside of the room, then the way to it."""
    covered = sum(box.overlap(other) for other in taken) / box.area
    outside = 1 - box.overlap(room) / box.area
    touched = (covered > 0) + (outside > _ROUNDING)
    return _TOUCHED * touched + 30 * (covered + 3 * outside) + box.gap(point) / box.height


def along_all(curves: Sequence[Sequence[Point]], half: float) -> Iterator[LabelBox]:
    """Yield what labels must not cover: markers that are `half` as wide from their middle, and lines between them."""
    for points in curves:
        for x, y in _along(points, half):
            yield LabelBox(x - half, y - half, 2 * half, 2 * half)


def _along(points: Sequence[Point], step: float) -> Iterator[Point]:
    """Yield the points of a line, and others between them, a step apart."""
    yield points[0]
    for one, other in pairwise(points):
        pieces = max(math.ceil(math.dist(one, other) / step), 1)
        for piece in range(1, pieces + 1):
            share = piece / pieces
            yield one[0] + (other[0] - one[0]) * share, one[1] + (other[1] - one[1]) * share
