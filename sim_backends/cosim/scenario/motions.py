"""Motions in a scenario file."""

from typing import Annotated, Literal

from fieldkit.config.schema import Bool, Field, Speed, Strict
from sim_backends.world.obstacles import Real

Point = Annotated[tuple[Real, ...], Field(min_length=2, max_length=3)]
"""Metres east and north, and for those who fly up; without the last at the height that it started at."""


class StandingPlan(Strict):
    """The agent stays where it starts.

    Attributes:
        kind: `standing`.
    """

    kind: Literal["standing"]


class WayPointsPlan(Strict):
    """The agent goes from point to point, and stays at the last.

    Attributes:
        kind: `way-points`.
        points_m: Where it goes from its start.
        speed: How fast.
        relative: Whether the points are counted from its start.
    """

    kind: Literal["way-points"]
    points_m: Annotated[tuple[Point, ...], Field(min_length=1)]
    speed: Annotated[Speed, Field(gt=0)]
    relative: Bool = False


MotionPlan = Annotated[StandingPlan | WayPointsPlan, Field(discriminator="kind")]
