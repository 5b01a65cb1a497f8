"""Placement of labels next to their points without overlap: greedy and deterministic."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

Point = tuple[float, float]
"""Position in typographic points (1/72 inch), from the lower left corner of the figure."""

_DISTANCE_FACTOR = 1.3
"""Factor by which the distance of a label from its point grows until it does not cover anything."""
_MAX_STEPS = 12
_OVERLAP_COST = 10.0
"""Cost of any overlap, as a distance from the point in heights of the label."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class LabelBox:
    """A rectangle, in typographic points.

    Attributes:
        left: Its left side.
        bottom: Its lower side.
        width: Its width.
        height: Its height.
    """

    left: float
    bottom: float
    width: float
    height: float

    def overlap(self, other: "LabelBox") -> float:
        """Return the area that both cover."""
        width = min(self.left + self.width, other.left + other.width) - max(self.left, other.left)
        height = min(self.bottom + self.height, other.bottom + other.height) - max(self.bottom, other.bottom)
        return max(width, 0.0) * max(height, 0.0)

    def gap(self, point: Point) -> float:
        """Return the distance of a point from the rectangle, 0 inside."""
        across = max(self.left - point[0], 0.0, point[0] - self.left - self.width)
        up = max(self.bottom - point[1], 0.0, point[1] - self.bottom - self.height)
        return math.hypot(across, up)

    @property
    def area(self) -> float:
        """Its area."""
        return self.width * self.height


def place_labels(
    anchors: Sequence[Sequence[Point]],
    sizes: Sequence[tuple[float, float]],
    bounds: LabelBox,
    obstacles: Sequence[LabelBox],
) -> list[tuple[Point, LabelBox]]:
    """Return, for each label, the point that it belongs to and a box that overlaps as little as possible.

    Args:
        anchors: For each label, the points of its curve; the label may be next to any of them.
        sizes: Width and height of each label.
        bounds: The area in which labels may be.
        obstacles: Boxes that labels must not cover: the points themselves, and lines.
    """
    placed: list[tuple[Point, LabelBox]] = []
    for points, size in zip(anchors, sizes, strict=True):
        covered = [*obstacles, *(box for _, box in placed)]
        candidates = ((point, box) for point in points for box in _boxes_around(point, size))
        placed.append(min(candidates, key=lambda candidate: _cost(candidate[1], candidate[0], bounds, covered)))
    return placed


def stack_labels(
    anchors: Sequence[Point], sizes: Sequence[tuple[float, float]], left: float, bounds: LabelBox
) -> list[LabelBox]:
    """Return a box for each label, stacked in the order of their points, as close to the points' heights as possible.

    Args:
        anchors: The point of each label.
        sizes: Width and height of each label.
        left: Left side of all labels.
        bounds: The area in which labels may be.
    """
    order = sorted(range(len(anchors)), key=lambda index: anchors[index][1])
    bottoms: dict[int, float] = {}
    free = bounds.bottom
    for index in order:
        bottoms[index] = max(anchors[index][1] - sizes[index][1] / 2, free)
        free = bottoms[index] + sizes[index][1]
    top = bounds.bottom + bounds.height
    for index in reversed(order):  # move labels above the upper bound down again
        bottoms[index] = min(bottoms[index], top - sizes[index][1])
        top = bottoms[index]
    return [LabelBox(left, bottoms[index], *sizes[index]) for index in range(len(anchors))]


def _boxes_around(point: Point, size: tuple[float, float]) -> Iterator[LabelBox]:
    x, y = point
    width, height = size
    away = height * 0.6
    for _ in range(_MAX_STEPS):
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
        away *= _DISTANCE_FACTOR


def _cost(box: LabelBox, point: Point, bounds: LabelBox, obstacles: Sequence[LabelBox]) -> float:
    """Return the cost of a box: overlap weighs most, then the part outside the bounds, then the distance."""
    covered = sum(box.overlap(other) for other in obstacles) / box.area
    outside = 1 - box.overlap(bounds) / box.area
    overlaps = (covered > 0) + (outside > _ROUNDING)
    return _OVERLAP_COST * overlaps + 30 * (covered + 3 * outside) + box.gap(point) / box.height


def curve_boxes(curves: Sequence[Sequence[Point]], half_width: float) -> Iterator[LabelBox]:
    """Yield boxes that cover curves: squares of `2 half_width` around their markers, and along the lines between."""
    for points in curves:
        for x, y in _interpolated(points, half_width):
            yield LabelBox(x - half_width, y - half_width, 2 * half_width, 2 * half_width)


def _interpolated(points: Sequence[Point], step: float) -> Iterator[Point]:
    """Yield the points of a polyline, and intermediate points at most a step apart."""
    yield points[0]
    for start, end in pairwise(points):
        pieces = max(math.ceil(math.dist(start, end) / step), 1)
        for piece in range(1, pieces + 1):
            share = piece / pieces
            yield start[0] + (end[0] - start[0]) * share, start[1] + (end[1] - start[1]) * share
