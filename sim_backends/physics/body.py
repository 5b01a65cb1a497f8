"""Protocols of a body that physics moves, what it is asked to do, and where it is.

A body is pure: from a pose under a command it tells a course, which is where it will be at every step from then on,
and nothing is computed before somebody asks. So the result does not depend on who asks when, and who stands costs
nothing.
"""

from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

from fieldkit.core.model import Vector
from sim_backends.physics.collisions import ContactStop, Surface

GRAVITY_M_S2: Final = 9.80665
"""Standard acceleration of gravity (CGPM 1901)."""


@dataclass(frozen=True, slots=True)
class Twist:
    """Command to a body on wheels, as ROS's `geometry_msgs/Twist` gives it.

    Attributes:
        forward_m_s: Speed ahead, below 0 for backwards.
        turn_rad_s: Rate of turn, above 0 to the left.
    """

    forward_m_s: float = 0.0
    turn_rad_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Velocity:
    """Command to a body that flies.

    Attributes:
        velocity_m_s: Metres per second east, north, up.
        yaw_rad: Where its nose points, from east towards north; None for where it points.
    """

    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None


class Pose(Protocol):
    """Where a body is and how it moves."""

    @property
    def place_m(self) -> Vector:
        """The lowest point of its middle, metres east, north, up."""
        ...

    @property
    def velocity_m_s(self) -> Vector:
        """Metres per second east, north, up."""
        ...

    @property
    def heading_rad(self) -> float:
        """Where it heads, from east towards north."""
        ...


PoseT = TypeVar("PoseT", bound=Pose)
PoseT_co = TypeVar("PoseT_co", bound=Pose, covariant=True)


class Course(Protocol[PoseT_co]):
    """Where a body is from a step on, if nothing else happens."""

    @property
    def steps(self) -> int | None:
        """For how many steps it is known; None for ever."""
        ...

    @property
    def moves(self) -> bool:
        """Whether its place changes; where it does not, the body stays until it is told something else."""
        ...

    def at(self, steps: int) -> PoseT_co:
        """Return where it is so many steps later, at most `Course.steps`."""
        ...


class Body(Protocol[PoseT]):
    """A kind of body, at its place of departure.

    Attributes:
        place_m: Where it is at time 0, metres east, north, up; up counts only if it flies.
        flies: Whether it is where it is whatever the ground's height; else it stands on it.
        steepest: The steepest ground that it drives on, rise over run; counts only if it does not fly.
        radius_m: Of the upright cylinder that contains it.
        height_m: Of that cylinder, whose lower face is at its place.
        antenna_m: How far its antenna is above its place.
        top_speed_m_s: What its speed never exceeds.
    """

    place_m: Vector
    flies: bool
    steepest: float
    radius_m: float
    height_m: float
    antenna_m: float
    top_speed_m_s: float

    def begin(self) -> PoseT:
        """Return its pose at time 0."""
        ...

    def placed(self, pose: PoseT, surface: Surface) -> PoseT:
        """Return a pose where it is, on the ground below it; the pose itself if it is there, or flies."""
        ...

    def course(self, pose: PoseT, command: object, step_s: float) -> Course[PoseT]:
        """Return what it does from a pose on under a command; None is the command of who was told nothing.

        Raises:
            ConfigurationError: It cannot be told this.
        """
        ...

    def stopped(self, pose: PoseT, stop: ContactStop, command: object) -> PoseT:
        """Return what becomes of a pose that a body would have had, had it not met anything.

        Args:
            pose: That pose.
            stop: Where it is instead, and what it met.
            command: What it was told last, None for nothing.
        """
        ...

    def limit_m_s2(self, pose: PoseT) -> float:
        """Return the most that its velocity changes per second from a pose on, whatever it is told."""
        ...
