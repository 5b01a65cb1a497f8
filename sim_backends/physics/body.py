"""Protocols of a body that the built-in physics federate moves: its commands, pose and track.

A body has no mutable state. From a pose and a command it derives a course: its motion until the next command or
contact. From a course, the pose at any later step can be computed on request. The pose therefore does not depend on
the times of requests, and a body at rest needs no computation. The states of all bodies at a step are also computed
on request, from their tracks.
"""

from collections.abc import Iterator, KeysView, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, TypeVar

from fieldkit.core.model import Vector
from sim_backends.physics.collisions import ContactStop, Surface
from sim_backends.world.motion import LEVEL, State, TiltedState


@dataclass(frozen=True, slots=True)
class Twist:
    """Command to a body on wheels, like ROS's `geometry_msgs/Twist`.

    Attributes:
        forward_m_s: Forward speed; negative for backwards.
        turn_rad_s: Yaw rate, positive to the left.
    """

    forward_m_s: float = 0.0
    turn_rad_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Velocity:
    """Command to a flying body.

    Attributes:
        velocity_m_s: Target velocity, metres per second east, north, up.
        yaw_rad: Target yaw, from east towards north; None keeps the current yaw.
    """

    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    yaw_rad: float | None = None


class Pose(Protocol):
    """Position and motion of a body."""

    @property
    def place_m(self) -> Vector:
        """The lowest point on its vertical axis, metres east, north, up."""
        ...

    @property
    def velocity_m_s(self) -> Vector:
        """Its velocity, metres per second east, north, up."""
        ...

    @property
    def heading_rad(self) -> float:
        """Its heading, from east towards north."""
        ...

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Its roll (positive with the left side up) and pitch (positive with the nose down) from level."""
        ...


PoseT = TypeVar("PoseT", bound=Pose)
PoseT_co = TypeVar("PoseT_co", bound=Pose, covariant=True)


class Course(Protocol[PoseT_co]):
    """The poses of a body from a step on, without a new command and without contacts."""

    @property
    def steps(self) -> int | None:
        """Number of steps for which it is valid; None for no limit."""
        ...

    @property
    def moves(self) -> bool:
        """True if the position changes; otherwise only the orientation may change until the next command."""
        ...

    def at(self, steps: int) -> PoseT_co:
        """Return the pose after this number of steps, at most `Course.steps`."""
        ...


class Body(Protocol[PoseT]):
    """A kind of body, with its initial position.

    Attributes:
        place_m: Position at time 0, metres east, north, up; up is used only if it flies.
        flies: True if its height is independent of the ground; otherwise it is on the ground.
        max_grade: Maximum grade of ground on which it drives, rise over run; used only if it does not fly.
        radius_m: Radius of the upright cylinder that contains it.
        height_m: Height of that cylinder, whose lower face is at its position.
        antenna_m: Height of its antenna above its position.
        top_speed_m_s: Upper bound of its speed.
    """

    place_m: Vector
    flies: bool
    max_grade: float
    radius_m: float
    height_m: float
    antenna_m: float
    top_speed_m_s: float

    def initial_pose(self) -> PoseT:
        """Return its pose at time 0."""
        ...

    def pose_at(self, place_m: Vector, heading_rad: float) -> PoseT:
        """Return its pose at rest at a position, which is defined as for `place_m`."""
        ...

    def on_surface(self, pose: PoseT, surface: Surface) -> PoseT:
        """Return the pose moved vertically to the ground; the same object if it is on the ground or flies."""
        ...

    def course(self, pose: PoseT, command: object, step_s: float) -> Course[PoseT]:
        """Return its course from a pose under a command, which is None before the first command.

        Raises:
            ConfigurationError: The command does not suit the body.
        """
        ...

    def after_contact(self, pose: PoseT, stop: ContactStop, command: object) -> PoseT:
        """Return the pose after a contact.

        Args:
            pose: The pose that the body would have without the contact.
            stop: Its position after the contact, and its contacts.
            command: Its last command; None before the first.
        """
        ...

    def limit_m_s2(self, pose: PoseT) -> float:
        """Return the maximum acceleration from a pose on, for any command."""
        ...


NEVER: Final = 1 << 62
"""A step after the end of any run."""


class Track(NamedTuple):
    """The motion of a body from a step on.

    Attributes:
        course: Its course.
        first_step: The first step of the course.
        antenna_m: Height of its antenna above its position.
    """

    course: Course[Pose]
    first_step: int
    antenna_m: float

    @property
    def end_step(self) -> int:
        """The last step for which the course is valid."""
        return NEVER if self.course.steps is None else self.first_step + self.course.steps

    def pose(self, step: int) -> Pose:
        """Return the pose at a step."""
        return self.course.at(step - self.first_step)

    def state(self, step: int) -> State:
        """Return the state of the antenna at a step."""
        pose = self.pose(step)
        east_m, north_m, up_m = pose.place_m
        antenna_m, tilt_rad = (east_m, north_m, up_m + self.antenna_m), pose.tilt_rad
        if tilt_rad is LEVEL:  # true for most robots; a call of TiltedState.of would take longer
            return State(antenna_m, pose.velocity_m_s, pose.heading_rad)
        return TiltedState.of(antenna_m, pose.velocity_m_s, pose.heading_rad, tilt_rad)


class Snapshot(Mapping[str, State]):
    """The states of all bodies at one step, each computed on request.

    Args:
        tracks: Their tracks at that step; the mapping must not be modified.
        step: The step.
    """

    def __init__(self, tracks: Mapping[str, Track], step: int) -> None:
        self._tracks = tracks
        self._step = step
        self._cache: dict[str, State] = {}

    def __getitem__(self, name: str) -> State:
        state = self._cache.get(name)
        if state is None:
            state = self._cache[name] = self._tracks[name].state(self._step)
        return state

    def keys(self) -> KeysView[str]:
        """Return the names of the bodies; as fast as `dict.keys`, because it is called in every window."""
        return self._tracks.keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self._tracks)

    def __len__(self) -> int:
        return len(self._tracks)
