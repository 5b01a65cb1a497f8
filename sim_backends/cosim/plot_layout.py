"""Content and layout of plots: curves, outlines of obstacles, directions of travel, and positions of labels."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from sim_backends.world.obstacles import Raised, Ramp
from sim_backends.world.shapes import Box
from sim_backends.world.world import World

Point = tuple[float, float]
"""Metres east and north, or typographic points (1/72 inch) from the lower left corner of the figure."""

_FLOOR_M: Final = 0.01
"""A shape whose lower side is at most this high is on the ground."""
_SHORTEST_ARROW_M: Final = 0.01
"""A path that extends less far than this has no direction of travel."""
_ARROW_SHARE: Final = 0.04
"""Length of an arrow, as a share of the diagonal of the rectangle that the path covers."""


@dataclass(frozen=True)
class Curve:
    """A labelled series of points.

    Attributes:
        name: Its name; the name of a sync policy determines its colour and marker.
        x: Values above 0, at least one.
        y: Values of at least 0, one for each x.
        label: Text next to it; if empty, its name.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float]
    label: str = ""


@dataclass(frozen=True)
class LogPanel:
    """Curves on two logarithmic axes; values of 0 are on a separate line below.

    Attributes:
        title: Title above the panel.
        x_label: Quantity and unit of x.
        y_label: Quantity and unit of y.
        curves: The curves.
        labels_at_right: True to stack the labels at the right, where the axis leaves space for them.
        over_time: True if x is a time that starts at 0: its axis is then linear, and there are no markers.
    """

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    labels_at_right: bool = False
    over_time: bool = False


@dataclass(frozen=True)
class FlowTrace:
    """The packets of a flow over time.

    Attributes:
        name: Its name.
        sent_s: Times of sending.
        delay_s: Time that each packet spent in the network; nan for packets that never arrived.
        distance_m: Distance of sender and receiver at each time of sending.
    """

    name: str
    sent_s: Sequence[float]
    delay_s: Sequence[float]
    distance_m: Sequence[float]


@dataclass(frozen=True)
class ObstacleOutline:
    """The outline of an obstacle, seen from above.

    Attributes:
        corners_m: Its corners, metres east and north.
        is_passable: True if robots on the ground may be within the outline: below a roof or a tree crown, or on
            higher ground.
    """

    corners_m: Sequence[Point]
    is_passable: bool


def outlines(world: World) -> Iterator[ObstacleOutline]:
    """Yield the outline of each part of a world's obstacles, beginning with higher ground."""
    for obstacle in sorted(world.obstacles, key=lambda obstacle: not isinstance(obstacle, Raised | Ramp)):
        for part in obstacle.parts():
            shape = part.shape
            height_m = shape.size_m[2] if isinstance(shape, Box) else shape.height_m
            is_above = shape.top_m - height_m > _FLOOR_M
            yield ObstacleOutline(shape.corners_m(), is_above or isinstance(obstacle, Raised | Ramp))


def direction_arrow(path_m: Sequence[Point]) -> tuple[Point, Point] | None:
    """Return the ends of an arrow at the end of a path, in the direction of travel; None without motion."""
    east_m, north_m = path_m[-1]
    extent_m = math.hypot(*(max(axis) - min(axis) for axis in zip(*path_m, strict=True)))
    for from_e, from_n in reversed(path_m):
        distance_m = math.dist((from_e, from_n), path_m[-1])
        if distance_m >= max(_ARROW_SHARE * extent_m, _SHORTEST_ARROW_M):
            return (from_e, from_n), (east_m, north_m)
    return None


_DISTANCE_FACTOR = 1.3
"""Factor between the candidate distances of a label from its point."""
_MAX_DISTANCES = 12
"""Number of candidate distances of a label from its point."""
_OVERLAP_COST = 10.0
"""Cost of any overlap. It equals the cost of a distance of 10 label heights between a label and its point."""
_ROUNDING = 1e-9
"""A smaller share of a label outside the bounds is a rounding error."""


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
        """Return the area of the overlap with another rectangle."""
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
    placed_labels: list[tuple[Point, LabelBox]] = []
    for points, size in zip(anchors, sizes, strict=True):
        covered = [*obstacles, *(box for _, box in placed_labels)]
        candidates = ((point, box) for point in points for box in _boxes_around(point, size))
        placed_labels.append(
            min(candidates, key=lambda candidate: _cost(candidate[1], candidate[0], bounds, covered))
        )
    return placed_labels


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
    next_bottom = bounds.bottom
    for index in order:
        bottoms[index] = max(anchors[index][1] - sizes[index][1] / 2, next_bottom)
        next_bottom = bottoms[index] + sizes[index][1]
    top = bounds.bottom + bounds.height
    for index in reversed(order):  # move labels above the upper bound down again
        bottoms[index] = min(bottoms[index], top - sizes[index][1])
        top = bottoms[index]
    return [LabelBox(left, bottoms[index], *sizes[index]) for index in range(len(anchors))]


def _boxes_around(point: Point, size: tuple[float, float]) -> Iterator[LabelBox]:
    """Yield boxes in eight directions from a point, the nearest first; 0.7 is about the cosine of a diagonal."""
    x, y = point
    width, height = size
    away = height * 0.6
    for _ in range(_MAX_DISTANCES):
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
    """Return the cost of a box.

    Most important is whether the box overlaps an obstacle or extends beyond the bounds, then how far, and then its
    distance from the point. The weights were chosen by eye.
    """
    covered = sum(box.overlap(other) for other in obstacles) / box.area
    outside = 1 - box.overlap(bounds) / box.area
    overlaps = (covered > 0) + (outside > _ROUNDING)
    return _OVERLAP_COST * overlaps + 30 * (covered + 3 * outside) + box.gap(point) / box.height


def curve_boxes(curves: Sequence[Sequence[Point]], half_width: float) -> Iterator[LabelBox]:
    """Yield squares with sides of `2 half_width` that cover curves, around markers and along the lines between."""
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
