"""Contacts of upright cylinders with their surroundings: a cylinder stops at an obstacle, and slides along it.

A moving body slides around an obstacle as far as possible; no body is pushed. A move is divided into pieces of at
most half a radius, so that a body cannot pass through even a thin obstacle. A body that would still overlap stays
at its previous position, which was free, so no body ever overlaps another body or an obstacle.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from fieldkit.core.model import Vector
from sim_backends.world.shapes import Box, Shape

TOUCH_M: Final = 1e-9
"""A smaller overlap counts as a touch, because rounding errors are that large."""
_PASSES: Final = 4
"""Maximum number of passes, needed when a body that is moved out of one obstacle enters another."""


@dataclass(frozen=True, slots=True)
class Collision:
    """The start of a contact.

    Attributes:
        at_ns: Its time.
        body: The moving body.
        obstacle: Name of the obstacle or body that it touched, or of the ground.
    """

    at_ns: int
    body: str
    obstacle: str


@dataclass(frozen=True, slots=True)
class Footprint:
    """The outline of an upright obstacle.

    Attributes:
        name: Name of the obstacle.
        closest_m: Returns its closest point to a given point, metres east and north; for a round obstacle, always
            the centre.
        reach_m: Radius of a round obstacle; 0 for an obstacle with edges.
        low_m: Height of its lower face.
        high_m: Height of its upper face.
        wall_m: Returns the height up to which it is an obstacle at one of its points; None if this is `high_m`
            everywhere.
    """

    name: str
    closest_m: Callable[[float, float], tuple[float, float]]
    reach_m: float
    low_m: float
    high_m: float
    wall_m: Callable[[float, float], float] | None = None


@dataclass(frozen=True, slots=True)
class Contact:
    """A contact with an obstacle.

    Attributes:
        name: Name of the obstacle.
        normal: Unit vector that points away from it.
    """

    name: str
    normal: Vector


@dataclass(frozen=True, slots=True)
class ContactStop:
    """The position at which a body was stopped.

    Attributes:
        place_m: Its position.
        contacts: Its contacts, in order.
    """

    place_m: Vector
    contacts: Sequence[Contact]

    def sliding_velocity(self, velocity: Vector) -> Vector:
        """Return a velocity without its components into the touched obstacles; 0 in a corner."""
        for contact in self.contacts:
            inward = sum(v * n for v, n in zip(velocity, contact.normal, strict=True))
            velocity = _add(velocity, contact.normal, -min(inward, 0.0))
        for contact in self.contacts:
            if sum(v * n for v, n in zip(velocity, contact.normal, strict=True)) < -TOUCH_M:
                return (0.0, 0.0, 0.0)  # a corner: the direction away from one side leads into the other
        return velocity


class Extent(Protocol):
    """An upright cylinder that contains a body; its position is the centre of its lower face.

    Attributes:
        radius_m: Its radius.
        height_m: Its height.
        flies: True if its height is independent of the ground.
    """

    radius_m: float
    height_m: float
    flies: bool


class Edge(Protocol):
    """Edges of raised ground, over which no body drives."""

    def edge_stop(self, from_m: Vector, to_m: Vector) -> tuple[str, Vector] | None:
        """Return the name of the area over whose edge a body would drive, and where it stops; None for no edge."""
        ...


@dataclass(frozen=True, slots=True)
class Surface:
    """The ground below a body.

    Attributes:
        height_m: Its height.
        grade: Its slope: rise per metre east and north.
    """

    height_m: float
    grade: tuple[float, float] = (0.0, 0.0)


def shape_footprint(name: str, shape: Shape) -> Footprint:
    """Return the footprint of a part of an obstacle."""
    east_m, north_m, _ = shape.centre_m
    if not isinstance(shape, Box):
        return Footprint(name, lambda _e, _n: (east_m, north_m), shape.radius_m, *_heights_m(shape))
    return Footprint(name, rectangle(shape.centre_m, shape.size_m, shape.yaw_rad), 0.0, *_heights_m(shape))


def _heights_m(shape: Shape) -> tuple[float, float]:
    """Return the heights of the lower and the upper face of a shape."""
    return 2 * shape.centre_m[2] - shape.top_m, shape.top_m


def cylinder_footprint(name: str, place_m: Vector, extent: Extent) -> Footprint:
    """Return the footprint of a body."""
    east_m, north_m, up_m = place_m
    return Footprint(name, lambda _e, _n: (east_m, north_m), extent.radius_m, up_m, up_m + extent.height_m)


def rectangle(
    centre_m: Sequence[float], size_m: Sequence[float], yaw_rad: float
) -> Callable[[float, float], tuple[float, float]]:
    """Return a function that maps a point to the closest point of a rectangle (to itself inside the rectangle).

    Args:
        centre_m: Its centre, metres east, north; further items are ignored.
        size_m: Its edges, in metres.
        yaw_rad: Rotation of its first edge from east towards north.
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
    """Return the minimum distance between a cylinder and a footprint; 0 if they touch or overlap.

    The footprint counts up to `high_m` everywhere, even where `wall_m` is lower.
    """
    horizontal_m = _horizontal_gap_m(footprint, extent, place_m)
    vertical_m = max(place_m[2] - footprint.high_m, footprint.low_m - place_m[2] - extent.height_m)
    return math.hypot(max(horizontal_m, 0.0), max(vertical_m, 0.0))


def overlaps(footprint: Footprint, extent: Extent, place_m: Vector) -> bool:
    """Return True if a cylinder and a footprint overlap by more than a touch."""
    low_m, high_m = place_m[2], place_m[2] + extent.height_m
    if low_m >= footprint.high_m - TOUCH_M or high_m <= footprint.low_m + TOUCH_M:
        return False
    if _horizontal_gap_m(footprint, extent, place_m) >= -TOUCH_M:
        return False
    return footprint.wall_m is None or low_m < footprint.wall_m(*footprint.closest_m(place_m[0], place_m[1]))


def move(
    extent: Extent, from_m: Vector, to_m: Vector, footprints: Sequence[Footprint], edge: Edge | None = None
) -> ContactStop | None:
    """Return the position and contacts of a cylinder that is stopped before its target; None if its path is free.

    Args:
        extent: Its size.
        from_m: Its position, which is free.
        to_m: Its target, reached on a straight path.
        footprints: Footprints that may be in its way.
        edge: Edges over which it cannot drive, or None.
    """
    path_m = math.dist(from_m, to_m)
    place_m, contacts = _move_in_pieces(extent, from_m, to_m, footprints, edge)
    if not contacts:
        return None
    moved_m = math.dist(from_m, place_m)
    if moved_m > path_m:
        # The cylinder slid to a point that is further from its start than the target. The move is repeated with a
        # nearer target. If the end point is then still too far away, the cylinder does not move.
        place_m, retry_contacts = _move_in_pieces(
            extent, from_m, _interpolate(from_m, to_m, path_m / moved_m), footprints, edge
        )
        contacts += retry_contacts
        if math.dist(from_m, place_m) > path_m:
            place_m = from_m
    return ContactStop(place_m, tuple(contacts))


def is_supported(extent: Extent, place_m: Vector, footprints: Sequence[Footprint], gap_m: float) -> bool:
    """Return True if a cylinder would be stopped by a surface within a gap below it."""
    east_m, north_m, up_m = place_m
    stop = move(extent, place_m, (east_m, north_m, up_m - gap_m), footprints)
    return stop is not None and any(contact.normal[2] > 0 for contact in stop.contacts)


def _move_in_pieces(
    extent: Extent, from_m: Vector, to_m: Vector, footprints: Sequence[Footprint], edge: Edge | None
) -> tuple[Vector, list[Contact]]:
    """Return the position of a cylinder after a path, and its contacts."""
    pieces = max(math.ceil(2 * math.dist(from_m, to_m) / extent.radius_m), 1)
    offset_m = _scale(_subtract(to_m, from_m), 1 / pieces)
    place_m = from_m
    contacts: list[Contact] = []
    for number in range(1, pieces + 1):
        # Without a contact, the position is computed exactly as without this division into pieces.
        next_m = _add(place_m, offset_m) if contacts else _interpolate(from_m, to_m, number / pieces)
        place_m, new_contacts = _push_out(extent, place_m, next_m, footprints, edge)
        contacts += new_contacts
    return place_m, contacts


def _push_out(
    extent: Extent, from_m: Vector, to_m: Vector, footprints: Sequence[Footprint], edge: Edge | None
) -> tuple[Vector, list[Contact]]:
    """Return the position of a cylinder after a short path, and its contacts.

    The position is `from_m` if every pass finds contacts.
    """
    place_m = to_m
    contacts: list[Contact] = []
    for _ in range(_PASSES):
        new_contacts = []
        for footprint in footprints:
            if overlaps(footprint, extent, place_m):
                normal, depth_m = _exit_direction(footprint, extent, from_m, place_m)
                place_m = _add(place_m, normal, depth_m)
                new_contacts.append(Contact(footprint.name, normal))
        if edge is not None and (edge_stop := edge.edge_stop(from_m, place_m)) is not None:
            name, stop_m = edge_stop
            normal = _subtract(stop_m, place_m)
            new_contacts.append(Contact(name, _scale(normal, 1 / math.hypot(*normal))))
            place_m = stop_m
        if not new_contacts:
            return place_m, contacts
        contacts += new_contacts
    return from_m, contacts


def _exit_direction(footprint: Footprint, extent: Extent, from_m: Vector, place_m: Vector) -> tuple[Vector, float]:
    """Return the direction and distance out of an obstacle that a cylinder overlaps.

    The direction is vertical if a flying body came from above or below, otherwise horizontal and away from the
    closest point. A driving body that came from above or below, for example on a ramp below a roof, is moved back to
    its previous position, and so is a body whose axis is within the obstacle.
    """
    closest_e_m, closest_n_m = footprint.closest_m(place_m[0], place_m[1])
    east_m, north_m = place_m[0] - closest_e_m, place_m[1] - closest_n_m
    distance_m = math.hypot(east_m, north_m)
    is_above, is_below = (
        from_m[2] >= footprint.high_m - TOUCH_M,
        from_m[2] + extent.height_m <= footprint.low_m + TOUCH_M,
    )
    if extent.flies and is_above:
        return (0.0, 0.0, 1.0), footprint.high_m - place_m[2]
    if extent.flies and is_below:
        return (0.0, 0.0, -1.0), place_m[2] + extent.height_m - footprint.low_m
    if is_above or is_below or not distance_m:
        path_m = math.dist(from_m, place_m)
        return _scale(_subtract(from_m, place_m), 1 / (path_m or 1.0)), path_m
    return (east_m / distance_m, north_m / distance_m, 0.0), footprint.reach_m + extent.radius_m - distance_m


def _horizontal_gap_m(footprint: Footprint, extent: Extent, place_m: Vector) -> float:
    closest_e_m, closest_n_m = footprint.closest_m(place_m[0], place_m[1])
    to_centre_m = math.hypot(place_m[0] - closest_e_m, place_m[1] - closest_n_m)
    return to_centre_m - footprint.reach_m - extent.radius_m


def _interpolate(from_m: Vector, to_m: Vector, share: float) -> Vector:
    return _add(from_m, _subtract(to_m, from_m), share)


def _add(left: Vector, right: Vector, factor: float = 1.0) -> Vector:
    return left[0] + factor * right[0], left[1] + factor * right[1], left[2] + factor * right[2]


def _subtract(left: Vector, right: Vector) -> Vector:
    return _add(left, right, -1.0)


def _scale(vector: Vector, factor: float) -> Vector:
    return _add((0.0, 0.0, 0.0), vector, factor)
