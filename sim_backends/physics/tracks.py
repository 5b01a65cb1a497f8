"""Tracks of bodies from a step on, and their states at a step, computed on request."""

from collections.abc import Iterator, KeysView, Mapping
from typing import Final, NamedTuple

from sim_backends.physics.body import Course, Pose
from sim_backends.world.motion import State

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
        return State((east_m, north_m, up_m + self.antenna_m), pose.velocity_m_s, pose.heading_rad)


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
        """Return the names of the bodies; as fast as a dict's, because it is called in every window."""
        return self._tracks.keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self._tracks)

    def __len__(self) -> int:
        return len(self._tracks)
