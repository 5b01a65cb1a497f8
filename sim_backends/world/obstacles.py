"""Obstacles of a world file, and the shapes that each is made of."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Field, Int, Length, Number, Strict
from fieldkit.core.errors import did_you_mean
from fieldkit.core.model import Vector
from sim_backends.world.materials import MATERIALS
from sim_backends.world.shapes import Box, Cylinder, Shape

Real = Number | Int
"""A number as people write it, `2` or `2.5`: metres or degrees, as the key says."""
Coordinate = Annotated[Real, Field(ge=-1e6, le=1e6)]
"""Metres from the origin. The flat ground of a world means nothing beyond, and squares of distances stay finite."""
Place = tuple[Coordinate, Coordinate]
"""Metres east and north."""
Size = tuple[Annotated[Real, Field(gt=0)], Annotated[Real, Field(gt=0)], Annotated[Real, Field(gt=0)]]
Dimension = Annotated[Length, Field(gt=0)]

_STEPS: Final = 8
"""Of which a ramp is made where waves and whoever flies meet it."""


def _known(name: str) -> str:
    if name not in MATERIALS:
        hint = did_you_mean(name, MATERIALS, f"materials: {', '.join(MATERIALS)}")
        raise schema.validation_error(f"there is no material {name!r}; {hint}")
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
    """Something that stands in a world.

    Attributes:
        name: What it is called.
    """

    name: str

    @abstractmethod
    def parts(self) -> Iterator[Part]:
        """Yield the shapes that it is made of."""


class _Rectangular(_Obstacle):
    """An obstacle with a rectangle as its base.

    Attributes:
        centre_m: Centre of its base, metres east and north.
        size_m: Its outer edges, in metres.
        yaw_deg: How far its first edge is turned from east towards north.
    """

    centre_m: Place
    size_m: Size
    yaw_deg: Real = 0

    def _box(self, size_m: Vector, *, along_m: float = 0.0, across_m: float = 0.0, base_m: float = 0.0) -> Box:
        """Return a box with edges along its own, away from its centre by so much, its underside at `base_m`."""
        yaw = math.radians(self.yaw_deg)
        east_m = self.centre_m[0] + along_m * math.cos(yaw) - across_m * math.sin(yaw)
        north_m = self.centre_m[1] + along_m * math.sin(yaw) + across_m * math.cos(yaw)
        return Box((east_m, north_m, base_m + size_m[2] / 2), size_m, yaw)


class BoxObstacle(_Rectangular):
    """A solid box.

    Attributes:
        kind: `box`.
        base: Height of its underside.
        material: Of what it is.
    """

    kind: Literal["box"]
    base: Length = 0.0
    material: MaterialName

    @override
    def parts(self) -> Iterator[Part]:
        yield Part(self.name, self.material, self._box(self.size_m, base_m=self.base))


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

    @override
    def parts(self) -> Iterator[Part]:
        east_m, north_m = self.to_m[0] - self.from_m[0], self.to_m[1] - self.from_m[1]
        centre = ((self.from_m[0] + self.to_m[0]) / 2, (self.from_m[1] + self.to_m[1]) / 2, self.height / 2)
        size = (math.hypot(east_m, north_m), self.thickness, self.height)
        yield Part(self.name, self.material, Box(centre, size, math.atan2(north_m, east_m)))


class Building(_Rectangular):
    """Four walls and a flat roof, empty inside.

    Attributes:
        kind: `building`.
        thickness: Of walls and roof.
        material: Of what they are.
    """

    kind: Literal["building"]
    thickness: Dimension
    material: MaterialName

    @override
    def parts(self) -> Iterator[Part]:
        long_m, wide_m, high_m = self.size_m
        off = self.thickness
        under_m = high_m - off
        boxes = (
            *(self._box((long_m, off, under_m), across_m=side * (wide_m - off) / 2) for side in (1, -1)),
            *(self._box((off, wide_m - 2 * off, under_m), along_m=side * (long_m - off) / 2) for side in (1, -1)),
            self._box((long_m, wide_m, off), base_m=under_m),
        )
        yield from (Part(self.name, self.material, box) for box in boxes)


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

    @override
    def parts(self) -> Iterator[Part]:
        crown_m = self.height - self.crown_base
        crown = Cylinder((*self.at_m, self.crown_base + crown_m / 2), self.crown_radius, crown_m)
        yield Part(self.name, "foliage", crown)
        yield Part(self.name, "wood", Cylinder((*self.at_m, self.crown_base / 2), self.trunk_radius, self.crown_base))


class _HigherGround(_Rectangular):
    """Ground that is higher than around it: robots stand on it, and paths through it meet earth."""

    @property
    @abstractmethod
    def grade(self) -> tuple[float, float]:
        """How much it rises per metre east and north."""

    @property
    @abstractmethod
    def middle_m(self) -> float:
        """Its height in its middle."""

    def covers(self, place_m: tuple[float, float]) -> bool:
        """Return whether a place, metres east and north, is on it; its edge is."""
        east_m, north_m = place_m[0] - self.centre_m[0], place_m[1] - self.centre_m[1]
        cos, sin = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        along_m, across_m = east_m * cos + north_m * sin, north_m * cos - east_m * sin
        return abs(along_m) <= self.size_m[0] / 2 and abs(across_m) <= self.size_m[1] / 2

    def height_m(self, place_m: tuple[float, float]) -> float:
        """Return how high it is at a place on it."""
        east, north = self.grade
        return self.middle_m + east * (place_m[0] - self.centre_m[0]) + north * (place_m[1] - self.centre_m[1])


class Raised(_HigherGround):
    """Raised ground with upright sides.

    Attributes:
        kind: `raised`.
    """

    kind: Literal["raised"]

    @property
    @override
    def grade(self) -> tuple[float, float]:
        return 0.0, 0.0

    @property
    @override
    def middle_m(self) -> float:
        return self.size_m[2]

    @override
    def parts(self) -> Iterator[Part]:
        yield Part(self.name, "ground", self._box(self.size_m))


class Ramp(_HigherGround):
    """Ground that rises evenly along its first edge, from nothing to its height, with upright sides.

    Attributes:
        kind: `ramp`.
    """

    kind: Literal["ramp"]

    @property
    @override
    def grade(self) -> tuple[float, float]:
        yaw, rise = math.radians(self.yaw_deg), self.size_m[2] / self.size_m[0]
        return rise * math.cos(yaw), rise * math.sin(yaw)

    @property
    @override
    def middle_m(self) -> float:
        return self.size_m[2] / 2

    @override
    def parts(self) -> Iterator[Part]:
        """A flight of steps, each as high as the ramp is in its middle."""
        long_m, wide_m, high_m = self.size_m
        for number in range(_STEPS):
            share = (number + 0.5) / _STEPS
            step = self._box((long_m / _STEPS, wide_m, share * high_m), along_m=(share - 0.5) * long_m)
            yield Part(self.name, "ground", step)


Obstacle = Annotated[BoxObstacle | Wall | Building | Tree | Raised | Ramp, Field(discriminator="kind")]
