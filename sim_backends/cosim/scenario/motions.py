"""Motions in a scenario file."""

from typing import Annotated, Literal

from fieldkit.config.schema import Bool, Duration, Field, Length, Speed, Strict
from sim_backends.cosim.scenario.names import AgentNames
from sim_backends.world.obstacles import Coordinate, Real

Point = Annotated[tuple[Coordinate, ...], Field(min_length=2, max_length=3)]
"""Metres east and north, and up for those who fly; without the last at the height that it started at."""


class StandingPlan(Strict):
    """The agent is told nothing, so that it stays where it starts.

    Attributes:
        kind: `standing`.
    """

    kind: Literal["standing"] = "standing"


class WayPointsPlan(Strict):
    """The agent goes from point to point, and stays at the last.

    Attributes:
        kind: `way-points`.
        points_m: Where it goes from its start: metres east and north, and up for those who fly.
        speed: How fast.
        relative: Whether the points are counted from its start.
        wait: How long it stays at its start before.
    """

    kind: Literal["way-points"]
    points_m: Annotated[tuple[Point, ...], Field(min_length=1)]
    speed: Annotated[Speed, Field(gt=0)]
    relative: Bool = False
    wait: Duration = 0.0


class LegPlan(Strict):
    """A part of a velocity profile.

    Attributes:
        duration: How long it lasts.
        speed: How fast the agent goes meanwhile, the way it heads at the start if it flies, else straight ahead.
        turn_deg_s: How fast it turns to the left if it drives, in degrees per second.
        climb_m_s: How fast it climbs if it flies, in metres per second.
    """

    duration: Annotated[Duration, Field(gt=0)]
    speed: Speed = 0.0
    turn_deg_s: Real = 0
    climb_m_s: Real = 0


class VelocityProfilePlan(Strict):
    """The agent goes at one velocity after the other, and then stands.

    Attributes:
        kind: `velocity-profile`.
        legs: The velocities, each with its duration.
    """

    kind: Literal["velocity-profile"]
    legs: Annotated[tuple[LegPlan, ...], Field(min_length=1)]


class FollowPlan(Strict):
    """The agent follows others by what it hears of them over the network, and by nothing else.

    One that drives keeps behind one leader, by a distance and a time; one that flies keeps over the middle of one or
    several. Traffic of the kind `stream` has to carry their states to it.

    Attributes:
        kind: `follow`.
        leader: Whom it follows, one agent or, if it flies, a list of several.
        distance: How far behind it stands, or how far above it flies; from antenna to antenna.
        headway: By which time it drives behind, beside the distance.
        timeout: After how long without a state it stops.
    """

    kind: Literal["follow"]
    leader: AgentNames
    distance: Annotated[Length, Field(gt=0)]
    headway: Annotated[Duration, Field(gt=0)] = 1.0
    timeout: Annotated[Duration, Field(gt=0)] = 1.0


class StationKeepingPlan(Strict):
    """The agent, which flies, steers back to where it started whenever it is elsewhere.

    Attributes:
        kind: `station-keeping`.
    """

    kind: Literal["station-keeping"]


MotionPlan = Annotated[
    StandingPlan | WayPointsPlan | VelocityProfilePlan | FollowPlan | StationKeepingPlan, Field(discriminator="kind")
]
"""What an agent does."""
