"""World files: obstacles, ground and lines for the robots."""

import math
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final

from fieldkit.config import schema
from fieldkit.config.catalog import Named
from fieldkit.config.schema import Field, Strict
from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Scenario
from sim_backends.world.obstacles import Obstacle, Part, Place, Raised, Ramp, Real

SHIPPED: Final = Path(__file__).parent / "worlds"
"""Folder of the shipped worlds."""


class Line(Strict):
    """Line on which the robots of a trial are placed, starting at the sender.

    Attributes:
        from_m: The sender's position, metres east and north.
        bearing_deg: Direction of the line, clockwise from north.
    """

    from_m: Place
    bearing_deg: Real

    def at(self, distance_m: float, left_m: float = 0.0) -> tuple[float, float]:
        """Return the point at a distance from the sender and to the left of the line, metres east and north."""
        bearing = math.radians(self.bearing_deg)
        sin, cos = math.sin(bearing), math.cos(bearing)
        return self.from_m[0] + distance_m * sin - left_m * cos, self.from_m[1] + distance_m * cos + left_m * sin


class World(Named):
    """The surroundings of emulated and simulated robots: `worlds/NAME.yaml` of the lab, or a shipped one.

    Coordinates are metres east and north of a corner. The ground is flat at height 0, except for raised ground and
    ramps. The antenna of an emulated robot is 0.2 m above the ground, or above its lowest point in flight. The robots
    of a trial are placed along the line of its scenario, in the compass direction `bearing_deg`: the sender at
    `from_m`, then the relay at the distance and the receiver at twice the distance (`master`), or the receiver at the
    distance (`masterless`).

    Attributes:
        name: The name of its file without `.yaml`.
        summary: Description in one line.
        area_m: Extent of the drawn area, metres east and north from the origin.
        obstacles: Its obstacles.
        lines: Lines for the robots of a trial, by scenario.
    """

    area_m: tuple[Annotated[Real, Field(gt=0)], Annotated[Real, Field(gt=0)]]
    obstacles: tuple[Obstacle, ...] = ()
    lines: dict[Scenario, Line] = Field(default_factory=dict)

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> "World":
        return self  # it is immutable, so a run and its forks may share it

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """All shapes of all obstacles."""
        return tuple(part for obstacle in self.obstacles for part in obstacle.parts())

    def ground_m(self, place_m: tuple[float, float]) -> float:
        """Return the height of the ground at a point, metres east and north."""
        raised = [obstacle for obstacle in self.obstacles if isinstance(obstacle, Raised | Ramp)]
        return max((obstacle.height_m(place_m) for obstacle in raised if obstacle.covers(place_m)), default=0.0)


def world_files() -> dict[str, Path]:
    """Return the files of worlds by name: those in the lab's folder `worlds/`, and shipped ones of other names."""
    return {path.stem: path for folder in (SHIPPED, Path("worlds")) for path in sorted(folder.glob("*.yaml"))}


def load_world(name: str) -> World:
    """Return a world by name: from the lab's folder `worlds/`, or one that ships with fieldkit.

    Raises:
        ConfigurationError: The world does not exist or is invalid; the error names the location.
    """
    paths = world_files()
    if name not in paths:
        raise ConfigurationError(
            f"there is no world {name!r}", remedy=did_you_mean(name, paths, f"worlds: {', '.join(paths)}")
        )
    return schema.load(paths[name], World)
