"""Obstacles of a world file, and their shapes."""

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
"""A number as in a YAML file, `2` or `2.5`: metres or degrees, depending on the key."""
Coordinate = Annotated[Real, Field(ge=-1e6, le=1e6)]
"""Metres from the origin. The limits keep squares of distances finite; a larger area of ground would not be flat."""
Place = tuple[Coordinate, Coordinate]
"""Metres east and north."""
Size = tuple[Annotated[Real, Field(gt=0)], Annotated[Real, Field(gt=0)], Annotated[Real, Field(gt=0)]]
Dimension = Annotated[Length, Field(gt=0)]

_STEPS: Final = 8
"""Number of steps of a ramp, for radio waves and for robots that do not drive on it."""


def _require_material(name: str) -> str:
    if name not in MATERIALS:
        hint = did_you_mean(name, MATERIALS, f"materials: {', '.join(MATERIALS)}")
        raise schema.validation_error(f"there is no material {name!r}; {hint}")
    return name


MaterialName = Annotated[str, AfterValidator(_require_material)]


@dataclass(frozen=True)
class Part:
    """A shape of one material.

    Attributes:
        obstacle: Name of its obstacle.
        material: Name of its material.
        shape: Its shape and position.
    """

    obstacle: str
    material: str
    shape: Shape


class _Obstacle(Strict, ABC):
    """An obstacle in a world.

    Attributes:
        name: Its name.
    """

    name: str

    @abstractmethod
    def parts(self) -> Iterator[Part]:
        """Yield its shapes."""


class _Rectangular(_Obstacle):
    """An obstacle with a rectangular base.

    Attributes:
        centre_m: Centre of its base, metres east and north.
        size_m: Its outer edges, in metres.
        yaw_deg: Rotation of its first edge from east towards north.
    """

    centre_m: Place
    size_m: Size
    yaw_deg: Real = 0

    def _box(self, size_m: Vector, *, along_m: float = 0.0, across_m: float = 0.0, base_m: float = 0.0) -> Box:
        """Return a box with edges parallel to the edges of the base, and with its underside at `base_m`.

        Its centre is shifted from the centre of the base along these edges.
        """
        yaw = math.radians(self.yaw_deg)
        east_m = self.centre_m[0] + along_m * math.cos(yaw) - across_m * math.sin(yaw)
        north_m = self.centre_m[1] + along_m * math.sin(yaw) + across_m * math.cos(yaw)
        return Box((east_m, north_m, base_m + size_m[2] / 2), size_m, yaw)


class BoxObstacle(_Rectangular):
    """A solid box.

    Attributes:
        kind: `box`.
        base: Height of its underside.
        material: Its material.
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
        to_m: The other end.
        height: Its height.
        thickness: Its thickness.
        material: Its material.
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
        thickness: Thickness of walls and roof.
        material: Their material.
    """

    kind: Literal["building"]
    thickness: Dimension
    material: MaterialName

    @schema.model_validator(mode="after")
    def _check_thickness(self) -> "Building":
        if 2 * self.thickness >= min(self.size_m[:2]) or self.thickness >= self.size_m[2]:
            raise schema.validation_error("the walls or the roof fill the whole building", "thickness")
        return self

    @override
    def parts(self) -> Iterator[Part]:
        long_m, wide_m, high_m = self.size_m
        thickness = self.thickness
        wall_height_m = high_m - thickness
        boxes = (
            *(
                self._box((long_m, thickness, wall_height_m), across_m=side * (wide_m - thickness) / 2)
                for side in (1, -1)
            ),
            *(
                self._box((thickness, wide_m - 2 * thickness, wall_height_m), along_m=side * (long_m - thickness) / 2)
                for side in (1, -1)
            ),
            self._box((long_m, wide_m, thickness), base_m=wall_height_m),
        )
        yield from (Part(self.name, self.material, box) for box in boxes)


class Tree(_Obstacle):
    """A trunk of wood and a crown of foliage, both upright cylinders.

    Attributes:
        kind: `tree`.
        at_m: Its position, metres east and north.
        height: Height of the top of its crown.
        crown_base: Height of the lower end of its crown, below `height`.
        crown_radius: Radius of the crown.
        trunk_radius: Radius of the trunk.
    """

    kind: Literal["tree"]
    at_m: Place
    height: Dimension
    crown_base: Dimension
    crown_radius: Dimension
    trunk_radius: Dimension

    @schema.model_validator(mode="after")
    def _check_crown(self) -> "Tree":
        if self.crown_base >= self.height:
            raise schema.validation_error("the lower end of the crown must be below its top", "crown_base")
        return self

    @override
    def parts(self) -> Iterator[Part]:
        crown_m = self.height - self.crown_base
        crown = Cylinder((*self.at_m, self.crown_base + crown_m / 2), self.crown_radius, crown_m)
        yield Part(self.name, "foliage", crown)
        yield Part(self.name, "wood", Cylinder((*self.at_m, self.crown_base / 2), self.trunk_radius, self.crown_base))


class _HigherGround(_Rectangular):
    """Ground that is higher than its surroundings: robots drive on it, and radio paths cross its material."""

    @property
    @abstractmethod
    def grade(self) -> tuple[float, float]:
        """Its rise per metre east and north."""

    @property
    @abstractmethod
    def middle_m(self) -> float:
        """Its height at its centre."""

    def covers(self, place_m: tuple[float, float]) -> bool:
        """Return True if a point, metres east and north, is on it or on its edge."""
        east_m, north_m = place_m[0] - self.centre_m[0], place_m[1] - self.centre_m[1]
        cos, sin = math.cos(math.radians(self.yaw_deg)), math.sin(math.radians(self.yaw_deg))
        along_m, across_m = east_m * cos + north_m * sin, north_m * cos - east_m * sin
        return abs(along_m) <= self.size_m[0] / 2 and abs(across_m) <= self.size_m[1] / 2

    def height_m(self, place_m: tuple[float, float]) -> float:
        """Return its height at a point on it."""
        east, north = self.grade
        return self.middle_m + east * (place_m[0] - self.centre_m[0]) + north * (place_m[1] - self.centre_m[1])


class Raised(_HigherGround):
    """Raised ground with upright sides, on which robots can drive.

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
    """Ground that rises evenly along its first edge, from 0 to its height, with upright sides.

    For radio waves, and for robots that fly or for which it is too steep, the slope has eight steps.

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
        """Yield steps, each as high as the ramp at the middle of the step."""
        long_m, wide_m, high_m = self.size_m
        for number in range(_STEPS):
            share = (number + 0.5) / _STEPS
            step = self._box((long_m / _STEPS, wide_m, share * high_m), along_m=(share - 0.5) * long_m)
            yield Part(self.name, "ground", step)


Obstacle = Annotated[BoxObstacle | Wall | Building | Tree | Raised | Ramp, Field(discriminator="kind")]
