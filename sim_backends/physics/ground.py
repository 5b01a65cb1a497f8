"""The ground for bodies on wheels: flat, with raised areas and ramps.

A vertical face is a wall for bodies below it, and an edge for bodies above it. No body drives over an edge. Where a
ramp leads to raised ground, there is neither a wall nor an edge. Ground that is too steep for the grip of the tires
of a robot is also a wall for it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.physics.collisions import Footprint, Surface, rectangle, shape_footprint
from sim_backends.world.obstacles import Raised, Ramp
from sim_backends.world.world import World

_LEVEL_M: Final = 1e-3
"""Smaller differences in height count as level: a robot rolls over them."""
_ON_AREA_M: Final = 1e-6
"""A point up to this distance from an area counts as on it, because the computed distance has a rounding error."""
_FLOOR: Final = Footprint("ground", lambda east_m, north_m: (east_m, north_m), 0.0, -math.inf, 0.0)
"""The flat ground as an obstacle for flying bodies."""


@dataclass(frozen=True)
class _Area:
    """An area of ground that is higher than its surroundings.

    Attributes:
        obstacle: The raised area or ramp.
        nearest_m: Returns the point of the area that is closest to a given point, metres east and north.
    """

    obstacle: Raised | Ramp
    nearest_m: Callable[[float, float], tuple[float, float]]

    def distance_m(self, east_m: float, north_m: float) -> float:
        """Return the distance of a point from the area; 0 on it."""
        on_e_m, on_n_m = self.nearest_m(east_m, north_m)
        return math.hypot(on_e_m - east_m, on_n_m - north_m)

    def edge_m(self, east_m: float, north_m: float) -> float:
        """Return the distance of a point from its edge, inside or outside."""
        obstacle = self.obstacle
        e, n = east_m - obstacle.centre_m[0], north_m - obstacle.centre_m[1]
        cos, sin = math.cos(math.radians(obstacle.yaw_deg)), math.sin(math.radians(obstacle.yaw_deg))
        inside_m = min(
            obstacle.size_m[0] / 2 - abs(e * cos + n * sin), obstacle.size_m[1] / 2 - abs(n * cos - e * sin)
        )
        return inside_m if inside_m >= 0 else self.distance_m(east_m, north_m)


class Ground:
    """The ground of a world for bodies of one kind, and the obstacles on it.

    Args:
        world: The world; None for open flat ground.
        max_grade: Maximum grade on which the bodies drive, rise over run; None for flying bodies.

    Attributes:
        obstacles: Obstacles for the bodies, including sides of higher ground; for flying bodies also the floor.
    """

    def __init__(self, world: World | None, max_grade: float | None) -> None:
        self._areas = []
        footprints: list[Footprint] = [] if max_grade is not None else [_FLOOR]
        for obstacle in world.obstacles if world is not None else ():
            if (
                max_grade is not None
                and isinstance(obstacle, Raised | Ramp)
                and math.hypot(*obstacle.grade) <= max_grade
            ):
                nearest_m = rectangle(obstacle.centre_m, obstacle.size_m, math.radians(obstacle.yaw_deg))
                self._areas.append(_Area(obstacle, nearest_m))
            else:
                footprints += [shape_footprint(part.obstacle, part.shape) for part in obstacle.parts()]
        self.obstacles: Sequence[Footprint] = (*footprints, *map(self._side, self._areas))
        self._max_grade = max((math.hypot(*area.obstacle.grade) for area in self._areas), default=0.0)

    def surface(self, east_m: float, north_m: float) -> Surface:
        """Return the ground at a point: the highest area there, or flat ground at height 0."""
        areas = [area.obstacle for area in self._areas if area.distance_m(east_m, north_m) <= _ON_AREA_M]
        highest = max(areas, key=lambda area: area.height_m((east_m, north_m)), default=None)
        if highest is None:
            return Surface(0.0)
        return Surface(highest.height_m((east_m, north_m)), highest.grade)

    def edge_m(self, place_m: Vector) -> float:
        """Return the minimum distance to the edge of an area of ground; infinite if there is no area."""
        return min((area.edge_m(place_m[0], place_m[1]) for area in self._areas), default=math.inf)

    def edge_stop(self, from_m: Vector, to_m: Vector) -> tuple[str, Vector] | None:
        """Return the name of the area over whose edge a body would drive, and where it stops; None for no edge."""
        east_m, north_m, up_m = to_m
        drop_m = from_m[2] - self.surface(east_m, north_m).height_m
        if drop_m <= _LEVEL_M + self._max_grade * math.dist(from_m, to_m):
            return None
        areas_below = [
            area
            for area in self._areas
            if area.distance_m(from_m[0], from_m[1]) <= _LEVEL_M
            and abs(area.obstacle.height_m((from_m[0], from_m[1])) - from_m[2]) <= _LEVEL_M
        ]
        if not areas_below:
            return None
        nearest = min(areas_below, key=lambda area: area.distance_m(east_m, north_m))
        return nearest.obstacle.name, (*nearest.nearest_m(east_m, north_m), up_m)

    def _side(self, area: _Area) -> Footprint:
        top_m = area.obstacle.size_m[2]
        return Footprint(area.obstacle.name, area.nearest_m, 0.0, 0.0, top_m, partial(self._wall_m, area))

    def _wall_m(self, area: _Area, east_m: float, north_m: float) -> float:
        """Return the height up to which an area's side is a wall at a point; 0 if other ground leads up to it."""
        height_m = area.obstacle.height_m((east_m, north_m))
        other_areas = (
            other for other in self._areas if other is not area and other.distance_m(east_m, north_m) <= _LEVEL_M
        )
        lower_m = height_m - _LEVEL_M
        return 0.0 if any(other.obstacle.height_m((east_m, north_m)) >= lower_m for other in other_areas) else lower_m
