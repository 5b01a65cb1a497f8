"""The physics federate of bodies in a world: each follows its course, and stops at what it meets.

Bodies go in steps. A command takes effect at the first step that is not before the time that it was given at, and
what they do does not depend on how time is cut into calls. Two things make it fast. A course is computed where
somebody asks for a state, and only then. And whether bodies meet is looked at only for those that may, by a list of
neighbours (Verlet, Phys. Rev. 159, 98, 1967): who is farther from everything than its top speed brings it is free
until the list ends.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Vector
from sim_backends.physics.body import Body, Pose
from sim_backends.physics.collisions import move, of_cylinder, overlaps
from sim_backends.physics.grid import CellGrid
from sim_backends.physics.ground import Ground
from sim_backends.physics.neighbours import HORIZON_S, Near, Neighbours
from sim_backends.physics.paths import STEP_NS
from sim_backends.physics.tracks import NEVER, Snapshot, Track
from sim_backends.world.motion import State
from sim_backends.world.world import World


@dataclass(frozen=True, slots=True)
class Collision:
    """The beginning of a contact.

    Attributes:
        at_ns: Its time.
        body: Who met something.
        obstacle: What it met: an obstacle, another body, or the ground.
    """

    at_ns: int
    body: str
    obstacle: str


class Bodies:
    """Moves bodies in a world.

    Args:
        bodies: The bodies, by the name of their agent.
        world: What they stand on and may run into; None for open flat ground.
        step_ns: Own step: states are those at whole steps.

    Attributes:
        step_ns: As given.
        names: Of the bodies, in order.
        limits_m_s2: See `BodyLimits`; they hold from the states on that were asked for last.
        collisions: The beginnings of all contacts so far, in order of time.

    Raises:
        ConfigurationError: A body stands in something at time 0, or the step is no positive time.
    """

    def __init__(
        self, bodies: Mapping[str, Body[Any]], world: World | None = None, *, step_ns: int = STEP_NS
    ) -> None:
        if step_ns <= 0:
            raise ConfigurationError(f"a step of {step_ns} ns is no positive time", remedy="1000000 ns is usual")
        self.step_ns = step_ns
        self.collisions: list[Collision] = []
        self._bodies = dict(sorted(bodies.items()))
        self.names = tuple(self._bodies)
        kinds = {name: None if body.flies else body.steepest for name, body in self._bodies.items()}
        grounds = {steepest: Ground(world, steepest) for steepest in set(kinds.values())}
        self._grounds = {name: grounds[steepest] for name, steepest in kinds.items()}
        self._step_s = step_ns / 1e9
        self._horizon = max(round(HORIZON_S / self._step_s), 1)
        self._commands: dict[str, Any] = dict.fromkeys(self._bodies)
        self._told: dict[str, Any] = {}
        self._told_from = 0
        self._asked_ns = 0
        self.limits_m_s2: Mapping[str, float] = BodyLimits(self)
        self._step = 0
        self._moves = False
        self._ends = NEVER
        self._touching: Mapping[str, Collection[str]] = {}
        self._tracks: dict[str, Track] = {}
        self._take_up({name: self._track(name, self._begin(name), 0) for name in self._bodies})
        self._listed = 0
        self._check_free()
        self._neighbours = Neighbours(self._bodies, self._poses(), self._grounds, self._horizon * self._step_s)
        self._states = Snapshot(self._tracks, 0)

    def limit_m_s2(self, name: str) -> float:
        """Return the limit of one body, as `limits_m_s2` has it."""
        pose = self._tracks[name].pose(self._step)
        speed_m_s = math.hypot(*pose.velocity_m_s)
        limit_m_s2: float = self._bodies[name].limit_m_s2(pose)
        if not speed_m_s:
            return limit_m_s2
        free_s = self._list().free_s(name) - (self._step - self._listed) * self._step_s
        return limit_m_s2 + speed_m_s / free_s if free_s > 0 else math.inf

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """See `PhysicsFederate.advance`.

        Raises:
            ConfigurationError: A command is for no body, or for another kind of body.
        """
        if commands:
            self._told |= commands
            self._told_from = -(-self._asked_ns // self.step_ns)
        self._asked_ns = to_ns
        step = to_ns // self.step_ns
        if self._told and self._told_from <= step:
            self._go(self._told_from)
            self._obey()
        if step != self._step:
            self._go(step)
        return self._states

    def _obey(self) -> None:
        told, self._told = self._told, {}
        tracks = {}
        for name, command in told.items():
            if name not in self._bodies:
                remedy = did_you_mean(name, self._bodies, f"bodies: {', '.join(self._bodies)}")
                raise ConfigurationError(f"a command is for {name}, which is no body", remedy=remedy)
            if command != self._commands[name]:
                self._commands[name] = command
                tracks[name] = self._track(name, self._tracks[name].pose(self._step), self._step)
        self._take_up(tracks)

    def _go(self, step: int) -> None:
        while self._step < step:
            until = step
            near: Mapping[str, Near] = {}
            if self._moves:
                near = self._list().near
                if not any(self._tracks[name].course.moves for name in near):
                    near = {}  # none of those that are near anything will move until it is told to
                until = self._step + 1 if near else min(step, self._listed + self._horizon)
            self._follow(until)
            if near:
                self._meet(near, until)
            self._step = until
        self._states = Snapshot(self._tracks, step)

    def _list(self) -> Neighbours:
        """Return the list of neighbours, made anew if it has ended."""
        if self._step >= self._listed + self._horizon:
            self._listed = self._step
            self._neighbours = Neighbours(self._bodies, self._poses(), self._grounds, self._horizon * self._step_s)
        return self._neighbours

    def _follow(self, step: int) -> None:
        """Let each body have a course that is known until a step."""
        while self._ends < step:
            self._take_up(
                {
                    name: self._track(name, track.pose(track.ends), track.ends)
                    for name, track in self._tracks.items()
                    if track.ends < step
                }
            )

    def _meet(self, near: Mapping[str, Near], step: int) -> None:
        """Let bodies that move stop at what they meet in the step that ends now, one after the other."""
        before_m = {name: self._tracks[name].pose(step - 1).place_m for name in near}
        now_m = dict(before_m)
        tracks, touching = {}, {}
        for name in sorted(near):
            track = self._tracks[name]
            if not track.course.moves:
                continue
            pose = track.pose(step)
            around = [
                *near[name].footprints,
                *(of_cylinder(other, now_m[other], self._bodies[other]) for other in near[name].bodies),
            ]
            body, ground = self._bodies[name], near[name].ground
            stop = move(body, before_m[name], pose.place_m, around, ground)
            if stop is not None:
                touching[name] = {contact.name: None for contact in stop.contacts}
                pose = body.stopped(pose, stop, self._commands[name])
            settled = pose if ground is None and stop is None else self._settled(name, pose)
            if stop is not None or settled is not pose:
                tracks[name] = self._track(name, settled, step)
            now_m[name] = settled.place_m
        self._report(touching, step)
        self._take_up(tracks)

    def _report(self, touching: Mapping[str, Collection[str]], step: int) -> None:
        for name, names in touching.items():
            new = [other for other in names if other not in self._touching.get(name, ())]
            self.collisions += [Collision(step * self.step_ns, name, other) for other in new]
        self._touching = touching

    def _take_up(self, tracks: Mapping[str, Track]) -> None:
        if tracks:
            # Never in place: snapshots keep the mapping that they were made from.
            self._tracks = {**self._tracks, **tracks}
            self._moves = any(track.course.moves for track in self._tracks.values())
            self._ends = min(track.ends for track in self._tracks.values())

    def _track(self, name: str, pose: Pose, step: int) -> Track:
        body = self._bodies[name]
        return Track(body.course(pose, self._commands[name], self._step_s), step, body.antenna_m)

    def _begin(self, name: str) -> Pose:
        return self._settled(name, self._bodies[name].begin())

    def _settled(self, name: str, pose: Pose) -> Pose:
        """Return a pose on the ground that is below it; the pose itself where it is there, or flies."""
        settled: Pose = self._bodies[name].placed(pose, self._grounds[name].surface(*pose.place_m[:2]))
        return settled

    def _poses(self) -> dict[str, Pose]:
        return {name: track.pose(self._step) for name, track in self._tracks.items()}

    def _check_free(self) -> None:
        places_m = {name: pose.place_m for name, pose in self._poses().items()}
        grid = CellGrid(2 * max((body.radius_m for body in self._bodies.values()), default=0.0))
        for number, (name, body) in enumerate(self._bodies.items()):
            place_m = places_m[name]
            if not all(map(math.isfinite, place_m)):
                raise ConfigurationError(f"{name} begins at {place_m}", remedy="give it a place in finite metres")
            others = [self.names[other] for other in grid.near(place_m)]
            around = [of_cylinder(other, places_m[other], self._bodies[other]) for other in others]
            for footprint in (*self._grounds[name].around, *around):
                if overlaps(footprint, body, place_m):
                    raise ConfigurationError(
                        f"{name} begins within {footprint.name}, at {_metres(place_m)} m",
                        remedy=f"let it begin at least {body.radius_m:g} m away from everything",
                    )
            grid.add(number, place_m)


def _metres(place_m: Vector) -> str:
    return ", ".join(f"{metres:g}" for metres in place_m)


class BodyLimits(Mapping[str, float]):
    """The most that each body's velocity changes per second, so that no place is off by more than a t^2 / 2.

    The place meant is that after a time t at the velocity of now. A body that meets something stops at once, which no
    acceleration bounds, but this does. Let A be the most that its drive changes its velocity per second, v its speed,
    and c the time for which it certainly meets nothing. Contacts only take from its speed, which is at most v + A t;
    so from c on its velocity is off by at most 2 v + A t, and its place by at most A t^2 / 2 + 2 v (t - c), which is
    never more than (A + v / c) t^2 / 2. Who may be about to meet something has no limit: what is known of it holds
    for one step.
    """

    def __init__(self, bodies: Bodies) -> None:
        self._bodies = bodies

    def __getitem__(self, name: str) -> float:
        return self._bodies.limit_m_s2(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._bodies.names)

    def __len__(self) -> int:
        return len(self._bodies.names)
