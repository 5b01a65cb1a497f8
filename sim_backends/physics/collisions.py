"""Contacts of upright cylinders with what stands around them: they stop there, and slide along it.

Who moves goes around what is in the way, as far as it comes; nobody is pushed. A move is cut into pieces shorter than
half a radius, so that nobody gets through anything, however thin. Who would still overlap stays where it was, which
was free, so no two bodies ever overlap, and none overlaps an obstacle.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from fieldkit.core.model import Vector
from sim_backends.world.shapes import Box, Shape

TOUCH_M: Final = 1e-9
"""Who overlaps by less touches: rounding alone is that large."""
_PASSES: Final = 4
"""Of pushing out, when what one obstacle pushes out of itself gets into another."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """Something upright that is in the way.

    Attributes:
        name: What it is called.
        closest_m: Returns the point of it from above that is nearest to a point outside, metres east and north.
        reach_m: How far it reaches around that point: the radius of a round one, 0 for one with edges.
        low_m: Height of its lower face.
        high_m: Height of its upper face.
        wall_m: Returns the height up to which it is in the way at a point of it; None where that is `high_m`.
    """

    name: str
    closest_m: Callable[[float, float], tuple[float, float]]
    reach_m: float
    low_m: float
    high_m: float
    wall_m: Callable[[float, float], float] | None = None


@dataclass(frozen=True, slots=True)
class Contact:
    """A touch.

    Attributes:
        name: Of what was touched.
        normal: Direction, of length 1, that leads away from it.
    """

    name: str
    normal: Vector


@dataclass(frozen=True, slots=True)
class ContactStop:
    """Where a body stopped short.

    Attributes:
        place_m: Where it is now.
        contacts: What it touched, in the order in which it met it.
    """

    place_m: Vector
    contacts: Sequence[Contact]

    def along(self, velocity: Vector) -> Vector:
        """Return what is left of a velocity when it leads into nothing that was touched."""
        for contact in self.contacts:
            into = sum(v * n for v, n in zip(velocity, contact.normal, strict=True))
            velocity = _plus(velocity, contact.normal, -min(into, 0.0))
        for contact in self.contacts:
            if sum(v * n for v, n in zip(velocity, contact.normal, strict=True)) < -TOUCH_M:
                return (0.0, 0.0, 0.0)  # a corner: what leads out of one side leads into the other
        return velocity


class Extent(Protocol):
    """An upright cylinder that contains a body; its place is the centre of its lower face.

    Attributes:
        radius_m: Its radius.
        height_m: Its height.
        flies: See `Body.flies`.
    """

    radius_m: float
    height_m: float
    flies: bool


class Edge(Protocol):
    """Where ground ends in the air."""

    def back_m(self, from_m: Vector, to_m: Vector) -> tuple[str, Vector] | None:
        """Return the edge that a body would drive off on its way, and where it stops there; None for none."""
        ...


@dataclass(frozen=True, slots=True)
class Surface:
    """The ground below a body.

    Attributes:
        height_m: Its height.
        grade: How much it rises per metre east and north.
    """

    height_m: float
    grade: tuple[float, float] = (0.0, 0.0)


def of_shape(name: str, shape: Shape) -> Footprint:
    """Return the footprint of an obstacle's part."""
    east_m, north_m, _ = shape.centre_m
    if not isinstance(shape, Box):
        return Footprint(name, lambda _e, _n: (east_m, north_m), shape.radius_m, *_heights_m(shape))
    return Footprint(name, rectangle(shape.centre_m, shape.size_m, shape.yaw_rad), 0.0, *_heights_m(shape))


def _heights_m(shape: Shape) -> tuple[float, float]:
    return 2 * shape.centre_m[2] - shape.top_m, shape.top_m


def of_cylinder(name: str, place_m: Vector, extent: Extent) -> Footprint:
    """Return the footprint of a body."""
    east_m, north_m, up_m = place_m
    return Footprint(name, lambda _e, _n: (east_m, north_m), extent.radius_m, up_m, up_m + extent.height_m)


def rectangle(
    centre_m: Sequence[float], size_m: Sequence[float], yaw_rad: float
) -> Callable[[float, float], tuple[float, float]]:
    """Return what gives the point of a rectangle that is nearest to a point; that point itself if it is inside.

    Args:
        centre_m: Its centre, metres east, north, anything.
        size_m: Its edges, in metres.
        yaw_rad: How far its first edge is turned from east towards north.
    """
    centre_e_m, centre_n_m = centre_m[0], centre_m[1]
    half_along_m, half_across_m = size_m[0] / 2, size_m[1] / 2
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)

    def closest_m(east_m: float, north_m: float) -> tuple[float, float]:
        e, n = east_m - centre_e_m, north_m - centre_n_m
        along_m = min(max(e * cos + n * sin, -half_along_m), half_along_m)
        across_m = min(max(n * cos - e * sin, -half_across_m), half_across_m)
        return centre_e_m + along_m * cos - across_m * sin, centre_n_m + along_m * sin + across_m * cos

    return closest_m


def gap_m(footprint: Footprint, extent: Extent, place_m: Vector) -> float:
    """Return how far a cylinder has to go, at least, before it touches a footprint; 0 where it does."""
    aside_m = _apart_m(footprint, extent, place_m)
    over_m = max(place_m[2] - footprint.high_m, footprint.low_m - place_m[2] - extent.height_m)
    return math.hypot(max(aside_m, 0.0), max(over_m, 0.0))


def overlaps(footprint: Footprint, extent: Extent, place_m: Vector) -> bool:
    """Return whether a cylinder and a footprint have more than a touch in common."""
    low_m, high_m = place_m[2], place_m[2] + extent.height_m
    if low_m >= footprint.high_m - TOUCH_M or high_m <= footprint.low_m + TOUCH_M:
        return False
    if _apart_m(footprint, extent, place_m) >= -TOUCH_M:
        return False
    return footprint.wall_m is None or low_m < footprint.wall_m(*footprint.closest_m(place_m[0], place_m[1]))


def move(
    extent: Extent, from_m: Vector, to_m: Vector, around: Sequence[Footprint], edge: Edge | None = None
) -> ContactStop | None:
    """Return where a cylinder stops short of where it wants to go; None where nothing is in its way.

    Args:
        extent: Its size.
        from_m: Where it is, free.
        to_m: Where it wants to go, straight.
        around: What is around it, and may be in its way.
        edge: What it cannot drive off, if anything.
    """
    way_m = math.dist(from_m, to_m)
    place_m, met = _walk(extent, from_m, to_m, around, edge)
    if not met:
        return None
    went_m = math.dist(from_m, place_m)
    if went_m > way_m:
        # Who was pushed around a bend further than it wanted to go goes less far; in a corner, nowhere.
        place_m, more = _walk(extent, from_m, _between(from_m, to_m, way_m / went_m), around, edge)
        met += more
        if math.dist(from_m, place_m) > way_m:
            place_m = from_m
    return ContactStop(place_m, tuple(met))


def _walk(
    extent: Extent, from_m: Vector, to_m: Vector, around: Sequence[Footprint], edge: Edge | None
) -> tuple[Vector, list[Contact]]:
    """Return where a cylinder is after a way, and what it met."""
    pieces = max(math.ceil(2 * math.dist(from_m, to_m) / extent.radius_m), 1)
    piece_m = _scaled(_minus(to_m, from_m), 1 / pieces)
    place_m = from_m
    met: list[Contact] = []
    for number in range(1, pieces + 1):
        # Who met nothing yet is where it would be without all this, to the last digit.
        ahead_m = _plus(place_m, piece_m) if met else _between(from_m, to_m, number / pieces)
        place_m, contacts = _push_out(extent, place_m, ahead_m, around, edge)
        met += contacts
    return place_m, met


def _push_out(
    extent: Extent, from_m: Vector, to_m: Vector, around: Sequence[Footprint], edge: Edge | None
) -> tuple[Vector, list[Contact]]:
    """Return where a cylinder is after a short way, and what it met."""
    place_m = to_m
    met: list[Contact] = []
    for _ in range(_PASSES):
        contacts = []
        for footprint in around:
            if overlaps(footprint, extent, place_m):
                normal, depth_m = _normal(footprint, extent, from_m, place_m)
                place_m = _plus(place_m, normal, depth_m)
                contacts.append(Contact(footprint.name, normal))
        if edge is not None and (back := edge.back_m(from_m, place_m)) is not None:
            name, back_m = back
            normal = _minus(back_m, place_m)
            contacts.append(Contact(name, _scaled(normal, 1 / math.hypot(*normal))))
            place_m = back_m
        if not contacts:
            return place_m, met
        met += contacts
    return from_m, met


def _normal(footprint: Footprint, extent: Extent, from_m: Vector, place_m: Vector) -> tuple[Vector, float]:
    """Return the way out of an obstacle that a cylinder got into: up or down if it came from there, else aside.

    Who drives goes neither up nor down, but back: it meets something above itself on a ramp.
    """
    closest_e_m, closest_n_m = footprint.closest_m(place_m[0], place_m[1])
    east_m, north_m = place_m[0] - closest_e_m, place_m[1] - closest_n_m
    apart_m = math.hypot(east_m, north_m)
    above, below = from_m[2] >= footprint.high_m - TOUCH_M, from_m[2] + extent.height_m <= footprint.low_m + TOUCH_M
    if extent.flies and above:
        return (0.0, 0.0, 1.0), footprint.high_m - place_m[2]
    if extent.flies and below:
        return (0.0, 0.0, -1.0), place_m[2] + extent.height_m - footprint.low_m
    if above or below or not apart_m:
        way_m = math.dist(from_m, place_m)
        return _scaled(_minus(from_m, place_m), 1 / (way_m or 1.0)), way_m
    return (east_m / apart_m, north_m / apart_m, 0.0), footprint.reach_m + extent.radius_m - apart_m


def _apart_m(footprint: Footprint, extent: Extent, place_m: Vector) -> float:
    closest_e_m, closest_n_m = footprint.closest_m(place_m[0], place_m[1])
    to_centre_m = math.hypot(place_m[0] - closest_e_m, place_m[1] - closest_n_m)
    return to_centre_m - footprint.reach_m - extent.radius_m


def _between(from_m: Vector, to_m: Vector, share: float) -> Vector:
    return _plus(from_m, _minus(to_m, from_m), share)


def _plus(one: Vector, other: Vector, times: float = 1.0) -> Vector:
    return one[0] + times * other[0], one[1] + times * other[1], one[2] + times * other[2]


def _minus(one: Vector, other: Vector) -> Vector:
    return _plus(one, other, -1.0)


def _scaled(vector: Vector, times: float) -> Vector:
    return _plus((0.0, 0.0, 0.0), vector, times)
