"""The motions in a scenario file."""

from typing import Annotated, Literal

from fieldkit.config.schema import Bool, Duration, Field, Length, Speed, Strict
from sim_backends.cosim.scenario.names import AgentNames
from sim_backends.world.obstacles import Coordinate, Real

Point = Annotated[tuple[Coordinate, ...], Field(min_length=2, max_length=3)]
"""Metres east and north, and up for agents that fly; without the last, the height at the start is kept."""


class StandingPlan(Strict):
    """The agent gets no command, so that it stays where it starts.

    Attributes:
        kind: `standing`.
    """

    kind: Literal["standing"] = "standing"


class WayPointsPlan(Strict):
    """The agent moves from point to point, and stays at the last.

    Attributes:
        kind: `way-points`.
        points_m: The points after its start: metres east and north, and up for agents that fly.
        speed: Its speed.
        relative: True if the points are relative to its start.
        wait: Time that it stays at its start before.
    """

    kind: Literal["way-points"]
    points_m: Annotated[tuple[Point, ...], Field(min_length=1)]
    speed: Annotated[Speed, Field(gt=0)]
    relative: Bool = False
    wait: Duration = 0.0


class LegPlan(Strict):
    """A part of a velocity profile.

    Attributes:
        duration: Its duration.
        speed: Speed of the agent: straight ahead if it drives, in the direction of its initial heading if it flies.
        turn_deg_s: Rate of turn to the left if it drives, in degrees per second.
        climb_m_s: Climb rate if it flies, in metres per second.
    """

    duration: Annotated[Duration, Field(gt=0)]
    speed: Speed = 0.0
    turn_deg_s: Real = 0
    climb_m_s: Real = 0


class VelocityProfilePlan(Strict):
    """The agent moves with a sequence of velocities, and then stops.

    Attributes:
        kind: `velocity-profile`.
        legs: The velocities, each with its duration.
    """

    kind: Literal["velocity-profile"]
    legs: Annotated[tuple[LegPlan, ...], Field(min_length=1)]


class FollowPlan(Strict):
    """The agent follows others, using only their states that it receives over the network.

    An agent that drives keeps behind one leader, by a distance and a time; an agent that flies keeps above the centre
    of one or several leaders. Traffic of the kind `stream` must carry their states to it.

    Attributes:
        kind: `follow`.
        leader: The agent that it follows or, if it flies, a list of several.
        distance: Distance behind the leader at standstill, or height above it; from antenna to antenna.
        headway: Time headway behind the leader, in addition to the distance.
        timeout: Time without a state after which it stops.
    """

    kind: Literal["follow"]
    leader: AgentNames
    distance: Annotated[Length, Field(gt=0)]
    headway: Annotated[Duration, Field(gt=0)] = 1.0
    timeout: Annotated[Duration, Field(gt=0)] = 1.0


class StationKeepingPlan(Strict):
    """The agent, which flies, holds its start position.

    Attributes:
        kind: `station-keeping`.
    """

    kind: Literal["station-keeping"]


MotionPlan = Annotated[
    StandingPlan | WayPointsPlan | VelocityProfilePlan | FollowPlan | StationKeepingPlan, Field(discriminator="kind")
]
"""A motion of an agent."""
