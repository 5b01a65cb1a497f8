"""Tracks of bodies from a step on, and their states at a step, worked out when they are asked for."""

from collections.abc import Iterator, KeysView, Mapping
from typing import Final, NamedTuple

from sim_backends.physics.body import Course, Pose
from sim_backends.world.motion import State

NEVER: Final = 1 << 62
"""A step that no run comes to."""


class Track(NamedTuple):
    """What a body does from a step on.

    Attributes:
        course: Its course.
        began: The step with which that begins.
        antenna_m: How far its antenna is above its place.
    """

    course: Course[Pose]
    began: int
    antenna_m: float

    @property
    def ends(self) -> int:
        """The step until which it is known."""
        return NEVER if self.course.steps is None else self.began + self.course.steps

    def pose(self, step: int) -> Pose:
        """Return the pose at a step."""
        return self.course.at(step - self.began)

    def state(self, step: int) -> State:
        """Return the state of the antenna at a step."""
        pose = self.pose(step)
        east_m, north_m, up_m = pose.place_m
        return State((east_m, north_m, up_m + self.antenna_m), pose.velocity_m_s, pose.heading_rad)


class Snapshot(Mapping[str, State]):
    """The states of all bodies at one step, each worked out when it is asked for.

    Args:
        tracks: What they do at that step; the mapping never changes.
        step: The step.
    """

    def __init__(self, tracks: Mapping[str, Track], step: int) -> None:
        self._tracks = tracks
        self._step = step
        self._known: dict[str, State] = {}

    def __getitem__(self, name: str) -> State:
        state = self._known.get(name)
        if state is None:
            state = self._known[name] = self._tracks[name].state(self._step)
        return state

    def keys(self) -> KeysView[str]:
        """Return the names of the bodies; as quick as a dict's, and it is asked in every window."""
        return self._tracks.keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self._tracks)

    def __len__(self) -> int:
        return len(self._tracks)
