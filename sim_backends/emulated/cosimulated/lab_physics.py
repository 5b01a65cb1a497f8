"""The physics simulator of a lab, which moves the robots that programs drive.

Other robots stay where the lab has placed them.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import itemgetter
from typing import Any, Final, Protocol, runtime_checkable

from typing_extensions import override

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.emulated.cosimulated.clock import RealTime
from sim_backends.emulated.cosimulated.steering import Command, FlightSteering, Steering
from sim_backends.emulated.cosimulated.velocity_flights import VelocityFlights
from sim_backends.emulated.robot.spec import ANTENNA_M
from sim_backends.federates.protocols import PhysicsFederate
from sim_backends.physics.bodies import Bodies, coordinates_text
from sim_backends.physics.quadrotor import FlightStatus, FlightTarget
from sim_backends.world.motion import STILL, State

OFF_AIR_M: Final[Vector] = (0.0, 0.0, 1e7)
"""Position of a station that the lab has put out of range of all others: 10,000 km up."""

_POLL_NS: Final = 10_000_000
"""Polling interval of the paths that the lab assigns to robots."""
_MOVED_M: Final = 1e-6
"""A robot that the lab has placed less than this away from its last position has not been moved."""


@runtime_checkable
class Placing(PhysicsFederate, Protocol):
    """A physics simulator that can place a robot during a run.

    A physics simulator without this method is restarted instead.
    """

    def put(self, name: str, place_m: Vector, heading_rad: float) -> None:
        """Place a robot at a position, at rest.

        Args:
            name: The robot.
            place_m: Position of the ground below it, metres east, north, up.
            heading_rad: Its heading, from east towards north.
        """
        ...


@runtime_checkable
class Flying(PhysicsFederate, Protocol):
    """A physics simulator that moves drones according to the commands of their autopilots."""

    def flight_status(self, name: str) -> FlightStatus:
        """Return the position and attitude of a drone, and True if it rests on the ground or on an obstacle."""
        ...


StartPhysics = Callable[[Mapping[str, State]], PhysicsFederate]
"""Starts a physics simulator with the robots at these states of their antennas; its time starts at 0."""


class LabPhysics:
    """The physics simulator of a session of the co-simulation.

    It starts when the lab has placed all robots that can be driven. It moves a robot after the robot's first command.
    Before that command, and after the lab has placed the robot again, the robot stays where the lab has put it. A
    station without a body, such as the laptop, always stays there.

    Args:
        start: Starts the physics simulator.
        steerings: Steering of each robot that programs can drive.
        bodies: Names of the robots, which have a body.
        stations: Names of all stations.
        step_ns: Time step of the physics simulator.
        clock: Converts between simulated time and the monotonic clock.

    Attributes:
        step_ns: Time step of the physics simulator.
        limits_m_s2: Acceleration limit of each station; 0 if no program drives it.
    """

    def __init__(
        self,
        start: StartPhysics,
        steerings: Mapping[str, Steering],
        bodies: tuple[str, ...],
        stations: tuple[str, ...],
        *,
        step_ns: int,
        clock: RealTime,
    ) -> None:
        self.step_ns = step_ns
        self.limits_m_s2: Mapping[str, float] = _Limits(self, stations)
        self._start = start
        self._steerings = steerings
        self._bodies = bodies
        self._clock = clock
        self._physics: PhysicsFederate | None = None
        # Simulated time at which the time of the physics simulator was 0. It increases while the simulator is paused.
        self._started_ns = 0
        # Simulated time up to which the physics simulator has advanced, and the end of the last window.
        self._advanced_ns = 0
        self._now_ns = 0
        # Commands that the physics simulator receives when it advances next, and the last command of each robot.
        self._pending_commands: dict[str, Command] = {}
        self._active_commands: dict[str, Command] = {}
        # States that the lab has assigned, and the stations that it has put out of range of all others.
        self._assigned_states = dict.fromkeys(stations, State(OFF_AIR_M))
        self._hidden_stations: frozenset[str] = frozenset()
        # Position and heading with which each robot was last placed in the physics simulator.
        self._poses_in_physics: dict[str, tuple[Vector, float]] = {}
        self._physics_states: Mapping[str, State] = {}
        self._states: Mapping[str, State] = self._assigned_states
        # True if a state has changed since `_states` was computed.
        self._has_changed = True
        self._polled_ns = 0

    def place(self, states: Mapping[str, State], stations_on_air: frozenset[str]) -> None:
        """Place stations. Robots that are driven by their programs are not moved.

        Args:
            states: State of the antenna of each station that has a position.
            stations_on_air: Stations that are on the air; the network assumes that others are out of range.

        Raises:
            ConfigurationError: A robot would be placed within an obstacle or another robot.
            FederateError: The physics simulator failed.
        """
        self._poll_placements(self._clock.now_ns())
        self._assigned_states |= states
        self._hidden_stations = frozenset(self._assigned_states) - stations_on_air
        self._has_changed = True
        if self._steerings and all(steering.is_placed for steering in self._steerings.values()):
            self._place_bodies()

    @property
    def states(self) -> Mapping[str, State]:
        """The current states, including changes by the lab since the last call of `advance`."""
        return self._combine_states()

    def limit_m_s2(self, name: str) -> float:
        """Return the acceleration limit of a station; 0 if no program drives it."""
        steering = self._steerings.get(name)
        if self._physics is None or steering is None or not steering.is_driven:
            return 0.0
        return self._physics.limits_m_s2.get(name, math.inf)

    def advance(self, to_ns: int, commands: Mapping[str, Any]) -> Mapping[str, State]:  # noqa: ARG002 (see below)
        """Implement `PhysicsFederate.advance`; instead of `commands`, those of the robots' programs are applied."""
        if (now_ns := self._clock.now_ns()) - self._polled_ns >= _POLL_NS:
            self._poll_placements(now_ns)
        if self._physics is not None:
            for at_ns, name, command in sorted(self._commands(to_ns), key=itemgetter(0)):
                self._drive(name, max(at_ns, self._now_ns), command)
            self._advance(to_ns)
            self._report(to_ns)
        self._now_ns = to_ns
        if self._has_changed:
            self._has_changed = False
            self._states = self._combine_states()
        return self._states

    def close(self) -> None:
        """Stop the physics simulator."""
        if close := getattr(self._physics, "close", None):
            close()

    def _commands(self, to_ns: int) -> Iterator[tuple[int, str, Command]]:
        """Yield the commands of the robots' programs up to a time: time, name of the robot, command."""
        until_ns = self._clock.monotonic_ns(to_ns)
        for name, steering in self._steerings.items():
            for at_ns, command in steering.commands(until_ns):
                yield self._clock.simulated_ns(at_ns), name, command

    def _drive(self, name: str, at_ns: int, command: Command) -> None:
        """Apply a command to a robot from a time on. If the robot already follows this command, nothing is done.

        A drone in `VelocityFlights` follows it from the start of the window on, because each additional exchange with
        such a physics simulator takes long.
        """
        if self._active_commands.get(name) == command:
            return
        self._active_commands[name] = command
        if not (isinstance(self._physics, VelocityFlights) and isinstance(command, FlightTarget)):
            self._advance(at_ns)
        self._pending_commands[name] = command

    def _advance(self, to_ns: int) -> None:
        """Advance the physics simulator; its time does not advance while nothing moves in it."""
        physics = self._physics
        assert physics is not None
        if not self._pending_commands and all(steering.is_at_rest for steering in self._steerings.values()):
            self._started_ns += (to_ns - self._advanced_ns) // self.step_ns * self.step_ns
            self._advanced_ns = to_ns
            return
        self._advanced_ns = to_ns
        commands, self._pending_commands = self._pending_commands, {}
        states = physics.advance(max(to_ns - self._started_ns, 0), commands)
        if states is not self._physics_states:
            self._physics_states, self._has_changed = states, True

    def _report(self, to_ns: int) -> None:
        """Write the records of motion that are due."""
        # The states are those after the last whole step.
        at_ns = self._clock.monotonic_ns(to_ns - (to_ns - self._started_ns) % self.step_ns)
        for name, steering in self._steerings.items():
            if steering.is_driven and steering.is_report_due(at_ns):
                flight: FlightStatus | None = None
                if isinstance(steering, FlightSteering) and isinstance(self._physics, Flying):
                    flight = self._physics.flight_status(name)
                steering.report(at_ns, self._physics_states[name], flight)

    def _combine_states(self) -> Mapping[str, State]:
        """Return the state of each station: simulated if a program drives it, otherwise assigned by the lab."""
        states = dict(self._assigned_states)
        for name, steering in self._steerings.items():
            if steering.is_driven and self._physics is not None:
                states[name] = self._physics_states[name]
        for name in self._hidden_stations:
            states[name] = State(OFF_AIR_M)
        return states

    def _poll_placements(self, now_ns: int) -> None:
        """Stop the robots that the lab has placed since the last call; they are at rest until a new command."""
        self._polled_ns = now_ns
        for name, steering in self._steerings.items():
            state = self._physics_states.get(name)
            was_driven = steering.is_driven
            if steering.poll_placement(self._clock.monotonic_ns(now_ns)) is not None:
                self._has_changed = True
                self._active_commands.pop(name, None)
                if was_driven and state is not None:
                    self._assigned_states[name] = State(state.position_m)  # until the lab's request arrives
                    self._pending_commands[name] = steering.idle

    def _place_bodies(self) -> None:
        """Put the robots that the lab has moved at their positions in the physics simulator."""
        poses = {
            name: (
                self._assigned_states[name].position_m,
                self._steerings[name].heading_rad if name in self._steerings else 0.0,
            )
            for name in self._bodies
            if name not in self._steerings or not self._steerings[name].is_driven
        }
        new_poses = {name: pose for name, pose in poses.items() if _differs(pose, self._poses_in_physics.get(name))}
        if self._physics is not None and not new_poses:
            return
        self._poses_in_physics |= new_poses
        if isinstance(self._physics, Placing):
            for name, ((east_m, north_m, up_m), heading_rad) in new_poses.items():
                self._active_commands.pop(name, None)
                self._physics.put(name, (east_m, north_m, up_m - ANTENNA_M), heading_rad)
            self._check_overlaps(new_poses)
            self._physics_states = self._physics.advance(max(self._now_ns - self._started_ns, 0), {})
        else:
            self._restart()

    def _check_overlaps(self, names: Iterable[str]) -> None:
        """Raise ConfigurationError if one of the robots overlaps something, unless the lab moves it on a path."""
        if not isinstance(self._physics, Bodies):
            return
        for name in names:
            state = self._assigned_states[name]
            if state.velocity_m_s == STILL and (obstacle := self._physics.overlap(name)):
                raise ConfigurationError(
                    f"{name} would be within {obstacle}, at {coordinates_text(state.position_m)} m",
                    remedy="place it at a free position, or choose another world or distance",
                )

    def _restart(self) -> None:
        """Start the physics simulator with all robots at rest at their current positions."""
        self.close()
        self._physics = None
        self._active_commands.clear()
        states = {name: self._body_state(name) for name in self._bodies}
        self._poses_in_physics = {
            name: (state.position_m, state.heading_rad or 0.0) for name, state in states.items()
        }
        self._started_ns = self._now_ns - self._now_ns % self.step_ns
        self._advanced_ns = self._now_ns
        self._physics = self._start(states)
        self._physics_states = self._physics.advance(0, {})

    def _body_state(self, name: str) -> State:
        """Return the state at which a robot starts in a new physics simulator: its current position, at rest."""
        steering = self._steerings.get(name)
        if steering is not None and steering.is_driven and name in self._physics_states:
            state = self._physics_states[name]
            return State(state.position_m, heading_rad=state.heading_rad)
        return State(
            self._assigned_states[name].position_m, heading_rad=0.0 if steering is None else steering.heading_rad
        )


def _differs(pose: tuple[Vector, float], other: tuple[Vector, float] | None) -> bool:
    return other is None or math.dist(pose[0], other[0]) > _MOVED_M or pose[1] != other[1]


class _Limits(Mapping[str, float]):
    """The acceleration limits of all stations; a limit changes when a robot receives its first command."""

    def __init__(self, physics: LabPhysics, stations: tuple[str, ...]) -> None:
        self._physics = physics
        self._stations = stations

    def __getitem__(self, name: str) -> float:
        return self._physics.limit_m_s2(name)

    @override
    def __iter__(self) -> Iterator[str]:
        return iter(self._stations)

    def __len__(self) -> int:
        return len(self._stations)
