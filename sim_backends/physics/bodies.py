"""The built-in physics federate: bodies in a world follow their courses, and stop at a contact.

Bodies move in time steps. A command takes effect at the first step at or after the time of the command,
and the motion does not depend on how the time is divided into calls. Two measures make this fast. The course of a
body, which is its motion until the next command or contact, is evaluated only when a state is requested. Contacts are
checked only between bodies in a neighbour list (Verlet, Phys. Rev. 159, 98, 1967): a body that cannot reach another
body or an obstacle before the list expires, even at top speed, is not in the list.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, Final

from fieldkit.core.errors import ConfigurationError, did_you_mean
from fieldkit.core.model import Vector
from sim_backends.physics.body import NEVER, Body, Pose, Snapshot, Track
from sim_backends.physics.collisions import Collision, Footprint, cylinder_footprint, is_supported, move, overlaps
from sim_backends.physics.ground import Ground
from sim_backends.physics.neighbours import HORIZON_S, CellGrid, ContactCandidates, Neighbours
from sim_backends.physics.paths import STEP_NS
from sim_backends.physics.quadrotor import FlightPose, FlightStatus
from sim_backends.world.motion import Lifetime, State
from sim_backends.world.world import World

_SUPPORT_M: Final = 1e-3
"""Maximum distance between a quadrotor and the ground or obstacle that supports it."""
_ALWAYS: Final[Mapping[str, Lifetime]] = MappingProxyType({})
"""Lifetimes if all bodies exist during the whole run."""


class Bodies:
    """Moves bodies in a world.

    Args:
        bodies: The bodies, by the name of their agent.
        world: Ground and obstacles; None for open flat ground.
        step_ns: Time step; there are states only at whole steps.
        lifetimes: Lifetimes of the bodies that exist only during a part of the run. A body exists from the last step
            at or before the start of its lifetime, and is absent from the first step at or after the end.

    Attributes:
        step_ns: Time step.
        names: Names of the bodies, in order.
        limits_m_s2: Maximum acceleration of each body, which bounds the error of its extrapolated position
            (`BodyLimits`); valid from the time of the last returned states.
        collisions: The starts of all contacts so far, in order of time.

    Raises:
        ConfigurationError: A body overlaps something at its start, its start is not finite, or the step is not
            positive.
    """

    def __init__(
        self,
        bodies: Mapping[str, Body[Any]],
        world: World | None = None,
        *,
        step_ns: int = STEP_NS,
        lifetimes: Mapping[str, Lifetime] = _ALWAYS,
    ) -> None:
        if step_ns <= 0:
            raise ConfigurationError(f"a step of {step_ns} ns is not positive", remedy="use for example 1000000 ns")
        self.step_ns = step_ns
        self.collisions: list[Collision] = []
        self._bodies = dict(sorted(bodies.items()))
        self._present = self._bodies
        self._lifetimes = dict(lifetimes)
        self.names = tuple(self._bodies)
        grades = {name: None if body.flies else body.max_grade for name, body in self._bodies.items()}
        grounds = {max_grade: Ground(world, max_grade) for max_grade in set(grades.values())}
        self._grounds = {name: grounds[max_grade] for name, max_grade in grades.items()}
        self._step_s = step_ns / 1e9
        self._horizon = max(round(HORIZON_S / self._step_s), 1)
        self._commands: dict[str, Any] = dict.fromkeys(self._bodies)
        self._pending_commands: dict[str, Any] = {}
        self._commands_step = 0
        self._last_to_ns = 0
        self.limits_m_s2: Mapping[str, float] = BodyLimits(self)
        self._step = 0
        self._any_moves = False
        self._courses_end_step = NEVER
        self._touching: Mapping[str, Collection[str]] = {}
        self._tracks: dict[str, Track] = {}
        self._list_step = 0
        self._change_steps = sorted(
            {step for lifetime in lifetimes.values() for step in self._change_steps_of(lifetime)}, reverse=True
        )
        self._check_starts(self._bodies)
        self._update_present()
        self._states = Snapshot(self._tracks, 0)

    def start_states(self) -> dict[str, State]:
        """Return the states of all bodies at their starts, including bodies that have not appeared yet."""
        return {name: self._track(name, self._initial_pose(name), 0).state(0) for name in self.names}

    def limit_m_s2(self, name: str) -> float:
        """Return the maximum acceleration of a body (`BodyLimits`); if it is absent, the value at its start."""
        if name not in self._present:
            start_limit_m_s2: float = self._bodies[name].limit_m_s2(self._initial_pose(name))
            return start_limit_m_s2
        pose = self._tracks[name].pose(self._step)
        speed_m_s = math.hypot(*pose.velocity_m_s)
        limit_m_s2: float = self._bodies[name].limit_m_s2(pose)
        if not speed_m_s:
            return limit_m_s2
        min_time_to_contact_s = (
            self._current_neighbours().min_time_to_contact_s(name) - (self._step - self._list_step) * self._step_s
        )
        return limit_m_s2 + speed_m_s / min_time_to_contact_s if min_time_to_contact_s > 0 else math.inf

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:
        """Implement `PhysicsFederate.advance`.

        Raises:
            ConfigurationError: A command is for an unknown body or does not suit the body, or a body that appears
                overlaps another one.
        """
        if commands:
            self._pending_commands |= commands
            # The first step at or after the time of the commands; the two minus signs round up.
            self._commands_step = -(-self._last_to_ns // self.step_ns)
        self._last_to_ns = to_ns
        step = to_ns // self.step_ns
        if self._pending_commands and self._commands_step <= step:
            self._advance_steps(self._commands_step)
            self._apply_commands()
        if step != self._step:
            self._advance_steps(step)
        return self._states

    def put(self, name: str, place_m: Vector, heading_rad: float) -> None:
        """Put a body at a position, at rest and without a command; it may overlap something.

        Args:
            name: The body.
            place_m: Position, metres east, north, up; up is used only if it flies.
            heading_rad: Its heading, from east towards north.
        """
        self._commands[name] = None
        self._pending_commands.pop(name, None)
        pose = self._on_ground(name, self._bodies[name].pose_at(place_m, heading_rad))
        self._replace_tracks({name: self._track(name, pose, self._step)})
        self._neighbours = Neighbours(self._bodies, self._poses(), self._grounds, self._horizon * self._step_s)
        self._list_step = self._step
        self._states = Snapshot(self._tracks, self._step)

    def flight_status(self, name: str) -> FlightStatus:
        """Return attitude and support of a quadrotor.

        Raises:
            ConfigurationError: The body is not a quadrotor.
        """
        body, pose = self._bodies[name], self._tracks[name].pose(self._step)
        if not isinstance(pose, FlightPose):
            raise ConfigurationError(f"{name} is not a quadrotor", remedy="use the name of a body that flies")
        return FlightStatus(pose.place_m, pose.roll_rad, pose.pitch_rad, self._is_supported(name, body, pose.place_m))

    def _is_supported(self, name: str, body: Body[Any], place_m: Vector) -> bool:
        """Return True if a body would touch something below it after a very small move downwards."""
        candidates = self._current_neighbours().candidates.get(name)
        if candidates is None:
            return False
        footprints = [
            *candidates.footprints,
            *(
                cylinder_footprint(other, self._tracks[other].pose(self._step).place_m, self._bodies[other])
                for other in candidates.bodies
            ),
        ]
        return is_supported(body, place_m, footprints, _SUPPORT_M)

    def overlap(self, name: str) -> str:
        """Return the name of an obstacle or body that a body overlaps now; empty if there is none."""
        body, place_m = self._bodies[name], self._tracks[name].pose(self._step).place_m
        others = (
            cylinder_footprint(other, track.pose(self._step).place_m, self._bodies[other])
            for other, track in self._tracks.items()
            if other != name
        )
        return next(
            (
                footprint.name
                for footprint in (*self._grounds[name].obstacles, *others)
                if overlaps(footprint, body, place_m)
            ),
            "",
        )

    def _apply_commands(self) -> None:
        """Let the pending commands take effect at the current step; commands for absent bodies are discarded."""
        commands_by_name, self._pending_commands = self._pending_commands, {}
        tracks = {}
        for name, command in commands_by_name.items():
            if name not in self._bodies:
                remedy = did_you_mean(name, self._bodies, f"bodies: {', '.join(self._bodies)}")
                raise ConfigurationError(f"a command is for {name}, which is not a body", remedy=remedy)
            if command != self._commands[name] and name in self._present:
                self._commands[name] = command
                tracks[name] = self._track(name, self._tracks[name].pose(self._step), self._step)
        self._replace_tracks(tracks)

    def _advance_steps(self, step: int) -> None:
        while self._change_steps and self._change_steps[-1] <= step:
            self._move(self._change_steps.pop())
            self._update_present()
        self._move(step)
        self._states = Snapshot(self._tracks, step)

    def _move(self, step: int) -> None:
        """Move the bodies that are present up to a step."""
        while self._step < step:
            end_step = step
            candidates: Mapping[str, ContactCandidates] = {}
            if self._any_moves:
                candidates = self._current_neighbours().candidates
                if not any(self._tracks[name].course.moves for name in candidates):
                    candidates = {}  # no candidate moves before its next command
                end_step = self._step + 1 if candidates else min(step, self._list_step + self._horizon)
            self._extend_courses(end_step)
            if candidates:
                self._resolve_contacts(candidates, end_step)
            self._step = end_step

    def _change_steps_of(self, lifetime: Lifetime) -> Iterator[int]:
        """Yield the step in which a body appears, unless this is step 0, and the first step after it disappears."""
        if lifetime.appears_ns >= self.step_ns:
            yield lifetime.appears_ns // self.step_ns
        if lifetime.disappears_ns is not None:
            yield -(-lifetime.disappears_ns // self.step_ns)  # rounded up

    def _is_present(self, name: str) -> bool:
        """Return True if the lifetime of a body, extended to whole steps, includes the current step."""
        lifetime = self._lifetimes.get(name)
        if lifetime is None:
            return True
        first_step = lifetime.appears_ns // self.step_ns
        has_disappeared = (
            lifetime.disappears_ns is not None and -(-lifetime.disappears_ns // self.step_ns) <= self._step
        )
        return first_step <= self._step and not has_disappeared

    def _update_present(self) -> None:
        """Add the bodies that appear at the current step, and remove those that disappear.

        Raises:
            ConfigurationError: A body that appears overlaps another one.
        """
        present = {name: body for name, body in self._bodies.items() if self._is_present(name)}
        new_names = [name for name in present if name not in self._tracks]
        new_tracks = {name: self._track(name, self._initial_pose(name), self._step) for name in new_names}
        self._present = present
        self._use_tracks({name: new_tracks.get(name) or self._tracks[name] for name in present})
        self._check_no_overlap(new_names)
        self._list_step = self._step
        self._neighbours = Neighbours(present, self._poses(), self._grounds, self._horizon * self._step_s)

    def _current_neighbours(self) -> Neighbours:
        """Return the neighbour list, rebuilt if it has expired."""
        if self._step >= self._list_step + self._horizon:
            self._list_step = self._step
            self._neighbours = Neighbours(self._present, self._poses(), self._grounds, self._horizon * self._step_s)
        return self._neighbours

    def _extend_courses(self, step: int) -> None:
        """Compute new courses for the bodies whose courses end before a step."""
        while self._courses_end_step < step:
            self._replace_tracks(
                {
                    name: self._track(name, track.pose(track.end_step), track.end_step)
                    for name, track in self._tracks.items()
                    if track.end_step < step
                }
            )

    def _resolve_contacts(self, candidates: Mapping[str, ContactCandidates], step: int) -> None:
        """Stop the moving bodies at their contacts in the last step before `step`, in order of their names."""
        previous_m = {name: self._tracks[name].pose(step - 1).place_m for name in candidates}
        current_m = dict(previous_m)
        tracks, touching = {}, {}
        for name in sorted(candidates):
            track = self._tracks[name]
            if not track.course.moves:
                continue
            pose = track.pose(step)
            footprints = [
                *candidates[name].footprints,
                *(
                    cylinder_footprint(other, current_m[other], self._bodies[other])
                    for other in candidates[name].bodies
                ),
            ]
            body, ground = self._bodies[name], candidates[name].ground
            stop = move(body, previous_m[name], pose.place_m, footprints, ground)
            if stop is not None:
                touching[name] = {contact.name: None for contact in stop.contacts}
                pose = body.after_contact(pose, stop, self._commands[name])
            ground_pose = pose if ground is None and stop is None else self._on_ground(name, pose)
            if stop is not None or ground_pose is not pose:
                tracks[name] = self._track(name, ground_pose, step)
            current_m[name] = ground_pose.place_m
        self._record_collisions(touching, step)
        self._replace_tracks(tracks)

    def _record_collisions(self, touching: Mapping[str, Collection[str]], step: int) -> None:
        for name, names in touching.items():
            new_obstacles = [other for other in names if other not in self._touching.get(name, ())]
            self.collisions += [Collision(step * self.step_ns, name, other) for other in new_obstacles]
        self._touching = touching

    def _replace_tracks(self, tracks: Mapping[str, Track]) -> None:
        if tracks:
            # A new mapping is created, because snapshots keep the mapping from which they were made.
            self._use_tracks({**self._tracks, **tracks})

    def _use_tracks(self, tracks: dict[str, Track]) -> None:
        self._tracks = tracks
        self._any_moves = any(track.course.moves for track in tracks.values())
        self._courses_end_step = min((track.end_step for track in tracks.values()), default=NEVER)

    def _track(self, name: str, pose: Pose, step: int) -> Track:
        body = self._bodies[name]
        return Track(body.course(pose, self._commands[name], self._step_s), step, body.antenna_m)

    def _initial_pose(self, name: str) -> Pose:
        return self._on_ground(name, self._bodies[name].initial_pose())

    def _on_ground(self, name: str, pose: Pose) -> Pose:
        """Return a pose moved to the ground below it; the same object if it is on the ground or flies."""
        ground_pose: Pose = self._bodies[name].on_surface(pose, self._grounds[name].surface(*pose.place_m[:2]))
        return ground_pose

    def _poses(self) -> dict[str, Pose]:
        return {name: track.pose(self._step) for name, track in self._tracks.items()}

    def _check_starts(self, names: Iterable[str]) -> None:
        """Check that each body starts at finite coordinates, and not within an obstacle."""
        for name in names:
            place_m = self._initial_pose(name).place_m
            if not all(map(math.isfinite, place_m)):
                raise ConfigurationError(
                    f"{name} starts at {place_m}, which is not finite", remedy="use finite coordinates in metres"
                )
            self._check_free(name, place_m, self._grounds[name].obstacles)

    def _check_no_overlap(self, new_names: Collection[str]) -> None:
        """Check that bodies that appear now overlap no other body."""
        places_m = {name: pose.place_m for name, pose in self._poses().items()}
        names = [*(name for name in places_m if name not in new_names), *new_names]
        grid = CellGrid(2 * max((body.radius_m for body in self._present.values()), default=0.0))
        for number, name in enumerate(names):
            place_m = places_m[name]
            others = [names[other] for other in grid.nearby_indices(place_m)] if name in new_names else []
            footprints = [cylinder_footprint(other, places_m[other], self._bodies[other]) for other in others]
            self._check_free(name, place_m, footprints)
            grid.add(number, place_m)

    def _check_free(self, name: str, place_m: Vector, footprints: Iterable[Footprint]) -> None:
        """Check that a body does not overlap any of these footprints at its start."""
        body = self._bodies[name]
        for footprint in footprints:
            if overlaps(footprint, body, place_m):
                appears = f" when it appears at {self._step * self._step_s:g} s" if self._step else ""
                raise ConfigurationError(
                    f"{name} starts within {footprint.name}, at {coordinates_text(place_m)} m{appears}",
                    remedy=f"start it at least {body.radius_m:g} m away from obstacles and other bodies",
                )


def coordinates_text(place_m: Vector) -> str:
    """Return the coordinates of a position as text: `1, 2.5, 0`."""
    return ", ".join(f"{metres:g}" for metres in place_m)


class BodyLimits(Mapping[str, float]):
    """The maximum acceleration a of each body, such that its extrapolated position is wrong by at most a t^2 / 2.

    The extrapolation keeps the current velocity for a time t. A body that touches something stops immediately, with
    unbounded acceleration, but its position error is still bounded. Let A be the maximum acceleration by its drive, v
    its speed, and c the minimum time to a contact. A contact only reduces its speed, which is at most v + A t. After
    c, its velocity is therefore wrong by at most 2 v + A t, and its position by at most A t^2 / 2 + 2 v (t - c). This
    is at most (A + v / c) t^2 / 2. A body that may be about to touch something has an infinite limit: its
    extrapolation is valid for one step.
    """

    def __init__(self, bodies: Bodies) -> None:
        self._bodies = bodies

    def __getitem__(self, name: str) -> float:
        return self._bodies.limit_m_s2(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._bodies.names)

    def __len__(self) -> int:
        return len(self._bodies.names)
