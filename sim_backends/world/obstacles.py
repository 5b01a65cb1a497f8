"""What may stand in a world file, and the shapes that it is made of."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from fieldkit import config
from fieldkit.config import AfterValidator, Field, Int, Length, Number, Strict
from fieldkit.errors import nearest
from sim_backends.world.materials import MATERIALS
from sim_backends.world.shapes import Box, Cylinder, Shape

Metres = Number | Int
Place = tuple[Metres, Metres]
"""Metres east and north."""
Size = tuple[Annotated[Metres, Field(gt=0)], Annotated[Metres, Field(gt=0)], Annotated[Metres, Field(gt=0)]]
Dimension = Annotated[Length, Field(gt=0)]


def _known(name: str) -> str:
    if name not in MATERIALS:
        hint = nearest(name, MATERIALS, f"materials: {', '.join(MATERIALS)}")
        raise config.complaint(f"there is no material {name!r}; {hint}")
    return name


MaterialName = Annotated[str, AfterValidator(_known)]


@dataclass(frozen=True)
class Part:
    """A shape of one material.

    Attributes:
        obstacle: Name of the obstacle that it is of.
        material: Name of its material.
        shape: Where it is.
    """

    obstacle: str
    material: str
    shape: Shape


class _Obstacle(Strict, ABC):
    name: str

    @abstractmethod
    def parts(self) -> Iterator[Part]:
        """Yield the shapes that it is made of."""


class BoxObstacle(_Obstacle):
    """A solid box.

    Attributes:
        kind: `box`.
        centre_m: Centre of its base, metres east and north.
        size_m: Its edges, in metres.
        base: Height of its underside.
        yaw_deg: How far its first edge is turned from east towards north.
        material: Of what it is.
    """

    kind: Literal["box"]
    centre_m: Place
    size_m: Size
    base: Length = 0.0
    yaw_deg: Metres = 0
    material: MaterialName

    def parts(self) -> Iterator[Part]:
        """See `_Obstacle.parts`."""
        centre = (*self.centre_m, self.base + self.size_m[2] / 2)
        yield Part(self.name, self.material, Box(centre, self.size_m, math.radians(self.yaw_deg)))


class Wall(_Obstacle):
    """A straight upright wall.

    Attributes:
        kind: `wall`.
        from_m: One end of its centre line, metres east and north.
        to_m: The other.
        height: Its height.
        thickness: Its thickness.
        material: Of what it is.
    """

    kind: Literal["wall"]
    from_m: Place
    to_m: Place
    height: Dimension
    thickness: Dimension
    material: MaterialName

    def parts(self) -> Iterator[Part]:
        """See `_Obstacle.parts`."""
        east_m, north_m = self.to_m[0] - self.from_m[0], self.to_m[1] - self.from_m[1]
        centre = ((self.from_m[0] + self.to_m[0]) / 2, (self.from_m[1] + self.to_m[1]) / 2, self.height / 2)
        size = (math.hypot(east_m, north_m), self.thickness, self.height)
        yield Part(self.name, self.material, Box(centre, size, math.atan2(north_m, east_m)))


class Building(_Obstacle):
    """Four walls and a flat roof, empty inside.

    Attributes:
        kind: `building`.
        centre_m: Centre of its base, metres east and north.
        size_m: Its outer edges, in metres.
        yaw_deg: How far its first edge is turned from east towards north.
        thickness: Of walls and roof.
        material: Of what they are.
    """

    kind: Literal["building"]
    centre_m: Place
    size_m: Size
    yaw_deg: Metres = 0
    thickness: Dimension
    material: MaterialName

    def parts(self) -> Iterator[Part]:
        """See `_Obstacle.parts`."""
        long_m, wide_m, high_m = self.size_m
        off = self.thickness
        under_m = high_m - off
        yaw = math.radians(self.yaw_deg)
        for x, y, size in (
            (0.0, (wide_m - off) / 2, (long_m, off, under_m)),
            (0.0, (off - wide_m) / 2, (long_m, off, under_m)),
            ((long_m - off) / 2, 0.0, (off, wide_m - 2 * off, under_m)),
            ((off - long_m) / 2, 0.0, (off, wide_m - 2 * off, under_m)),
        ):
            east_m = self.centre_m[0] + x * math.cos(yaw) - y * math.sin(yaw)
            north_m = self.centre_m[1] + x * math.sin(yaw) + y * math.cos(yaw)
            yield Part(self.name, self.material, Box((east_m, north_m, under_m / 2), size, yaw))
        roof = Box((*self.centre_m, high_m - off / 2), (long_m, wide_m, off), yaw)
        yield Part(self.name, self.material, roof)


class Tree(_Obstacle):
    """A trunk of wood and a crown of foliage, both upright cylinders.

    Attributes:
        kind: `tree`.
        at_m: Where it stands, metres east and north.
        height: To the top of its crown.
        crown_base: Height at which the crown begins.
        crown_radius: Radius of the crown.
        trunk_radius: Radius of the trunk.
    """

    kind: Literal["tree"]
    at_m: Place
    height: Dimension
    crown_base: Dimension
    crown_radius: Dimension
    trunk_radius: Dimension

    def parts(self) -> Iterator[Part]:
        """See `_Obstacle.parts`."""
        crown_m = self.height - self.crown_base
        crown = Cylinder((*self.at_m, self.crown_base + crown_m / 2), self.crown_radius, crown_m)
        yield Part(self.name, "foliage", crown)
        yield Part(self.name, "wood", Cylinder((*self.at_m, self.crown_base / 2), self.trunk_radius, self.crown_base))


class Raised(_Obstacle):
    """Raised ground with upright sides: robots stand on it, and paths through it meet earth.

    Attributes:
        kind: `raised`.
        centre_m: Centre of its base, metres east and north.
        size_m: Its edges, in metres.
        yaw_deg: How far its first edge is turned from east towards north.
    """

    kind: Literal["raised"]
    centre_m: Place
    size_m: Size
    yaw_deg: Metres = 0

    def parts(self) -> Iterator[Part]:
        """See `_Obstacle.parts`."""
        box = Box((*self.centre_m, self.size_m[2] / 2), self.size_m, math.radians(self.yaw_deg))
        yield Part(self.name, "ground", box)

    def covers(self, place_m: tuple[float, float]) -> bool:
        """Return whether a place, metres east and north, is on it; its edge is."""
        east_m, north_m = place_m[0] - self.centre_m[0], place_m[1] - self.centre_m[1]
        cos, sin = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        along_m, across_m = east_m * cos + north_m * sin, north_m * cos - east_m * sin
        return abs(along_m) <= self.size_m[0] / 2 and abs(across_m) <= self.size_m[1] / 2


Obstacle = Annotated[BoxObstacle | Wall | Building | Tree | Raised, Field(discriminator="kind")]
