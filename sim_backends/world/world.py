"""World files: obstacles, ground and lines to stand along; and the loss of radio paths through them."""

import math
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np

from fieldkit.config import schema
from fieldkit.config.catalog import Named
from fieldkit.config.schema import Field, Strict
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Scenario
from sim_backends.world.materials import FOLIAGE, MATERIALS, Solid
from sim_backends.world.obstacles import Obstacle, Part, Place, Raised, Ramp, Real
from sim_backends.world.shapes import Floats, Solids

_SHIPPED: Final = Path(__file__).parent / "worlds"


@dataclass(frozen=True)
class ObstacleCrossing:
    """The stretch of a path that is inside one part of an obstacle.

    Attributes:
        obstacle: Its name.
        material: Name of the material.
        length_m: How long the stretch is.
    """

    obstacle: str
    material: str
    length_m: float


class Line(Strict):
    """Line along which the robots of a trial stand, from the sender on.

    Attributes:
        from_m: The sender's place, metres east and north.
        bearing_deg: Direction of the others from north over east, as a compass shows it.
    """

    from_m: Place
    bearing_deg: Real

    def at(self, distance_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """Return the place at a distance from the sender and to the left of the line, metres east and north."""
        bearing = math.radians(self.bearing_deg)
        sin, cos = math.sin(bearing), math.cos(bearing)
        return self.from_m[0] + distance_m * sin - left_m * cos, self.from_m[1] + distance_m * cos + left_m * sin


class World(Named):
    """What stands around the robots. The ground is flat at height 0 but where it is raised, or rises.

    Attributes:
        area_m: Extent of the area that is drawn, metres east and north from the origin.
        obstacles: What stands in it.
        lines: Where the robots of a trial stand, by scenario.
    """

    area_m: tuple[Annotated[Real, Field(gt=0)], Annotated[Real, Field(gt=0)]]
    obstacles: tuple[Obstacle, ...] = ()
    lines: dict[Scenario, Line] = Field(default_factory=dict)

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> "World":
        return self  # it never changes, so a run and its forks may share it

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Every shape of every obstacle."""
        return tuple(part for obstacle in self.obstacles for part in obstacle.parts())

    def crossings(self, start_m: Floats, end_m: Floats) -> list[tuple[ObstacleCrossing, ...]]:
        """Return what each of the straight paths between points of shape (n, 3) crosses, in the order of the file."""
        return [
            tuple(
                ObstacleCrossing(part.obstacle, part.material, length_m)
                for part, length_m in zip(self.parts, lengths_m, strict=True)
                if length_m > 0
            )
            for lengths_m in self._solids.depths_m(start_m, end_m).tolist()
        ]

    def penetration_loss_db(self, start_m: Floats, end_m: Floats, frequency_hz: float) -> Floats:
        """Return what obstacles take from waves along straight paths, in dB, shape (n,).

        A solid takes its loss per metre and what two faces reflect, as if met squarely and without echoes inside;
        foliage counts by its depth in all. What bends around an obstacle is left out, so that a thick one shadows
        more than in the open.

        Args:
            start_m: Where the paths begin, shape (n, 3).
            end_m: Where they end, shape (n, 3).
            frequency_hz: Of the wave.
        """
        depths = self._solids.depths_m(start_m, end_m)
        if not depths.any():
            return np.zeros(len(start_m))
        db_per_m, faces_db, leafy = _of_materials(self._materials, frequency_hz)
        loss_db: Floats = depths @ db_per_m + (depths > 0) @ faces_db
        loss_db += [FOLIAGE.loss_db(depth_m, frequency_hz) for depth_m in (depths @ leafy).tolist()]
        return loss_db

    def ground_m(self, place_m: tuple[float, float]) -> float:
        """Return the height of the ground at a place, metres east and north."""
        higher = [obstacle for obstacle in self.obstacles if isinstance(obstacle, Raised | Ramp)]
        return max((obstacle.height_m(place_m) for obstacle in higher if obstacle.covers(place_m)), default=0.0)

    @cached_property
    def _solids(self) -> Solids:
        return Solids([part.shape for part in self.parts])

    @cached_property
    def _materials(self) -> tuple[str, ...]:
        return tuple(part.material for part in self.parts)


@cache
def _of_materials(names: tuple[str, ...], frequency_hz: float) -> tuple[Floats, Floats, Floats]:
    """Return what each material takes per metre and by two faces, in dB, if it is solid, and 1 for foliage."""
    materials = [MATERIALS[name] for name in names]
    solids = [material if isinstance(material, Solid) else None for material in materials]
    return (
        np.array([solid.loss_db_per_m(frequency_hz) if solid else 0.0 for solid in solids]),
        np.array([2 * solid.face_loss_db(frequency_hz) if solid else 0.0 for solid in solids]),
        np.array([float(solid is None) for solid in solids]),
    )


def load_world(name: str) -> World:
    """Return a world by name: of the lab's own folder `worlds/`, or one that ships with fieldkit.

    Raises:
        ConfigurationError: There is none, or it is wrong; says where.
    """
    known = {path.stem: path for folder in (_SHIPPED, Path("worlds")) for path in sorted(folder.glob("*.yaml"))}
    if name not in known:
        raise ConfigurationError(
            f"there is no world {name!r}", remedy=did_you_mean(name, known, f"worlds: {', '.join(known)}")
        )
    return schema.load(known[name], World)
