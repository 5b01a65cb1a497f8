"""Mobility of robots in an emulated lab: positions and velocities over time, as the medium receives them.

The lab moves most robots. A robot steers itself if a program on board (a base controller or an autopilot) moves it.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import MappingProxyType, TracebackType
from typing import Final, Protocol, Self

from fieldkit.backends.protocols import Cast
from fieldkit.core import geometry
from fieldkit.core.errors import RobotError
from fieldkit.core.model import Move, Placement, Role, TrackPoint, Vector
from sim_backends.emulated import placement as positions
from sim_backends.emulated.motion_sections import mavlink_of
from sim_backends.emulated.nodes import EmulatedRobot, Laptop
from sim_backends.emulated.provisioning import RobotKey
from sim_backends.emulated.ros.motion_record import RecordedMotion
from sim_backends.world.motion import STILL, Attitude, Motion, State, attitude_of
from sim_backends.world.world import World

STEP_M: Final = 0.1
"""Distance that a robot may move between two updates of the medium.

At speeds above 5 m/s, `_MIN_PERIOD_S` makes the distance longer. At speeds below 1 m/s, or below 2 m/s if the robot
steers itself, `_MAX_PERIOD_S` or `WATCH_S` makes it shorter.

At the distance d, the path loss increases by 10 n / (d ln 10) dB per metre, with the path-loss exponent n. At 10 m
and n = 3 this is 1.3 dB/m, so a step changes it by 0.13 dB. Fading changes within a wavelength (0.12 m); between the
updates the medium extrapolates it with the velocities.
"""

_MIN_PERIOD_S: Final = 0.02
"""Minimum time between two updates of the medium while a robot moves."""
_MAX_PERIOD_S: Final = 0.1
"""Maximum time between two updates of the medium while the lab moves a robot."""

WATCH_S: Final = 0.05
"""Polling interval for robots that steer themselves, while they are at rest or slow; a robot that starts to drive at
0.2 m/s moves 1 cm within it."""


class MotionThread:
    """Thread that reports a motion step by step; use it as a context manager, which stops the thread on leaving.

    Args:
        step: Reports the current positions of the robots; returns the seconds until its next call, or None at the
            end.
        name: Name of the thread.

    Raises:
        BaseException: The error of `step`. It is raised when the context is left, unless its body raised an error.
    """

    def __init__(self, step: Callable[[], float | None], name: str = "motion") -> None:
        self._step = step
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        if self._error is not None and error is None:
            raise self._error

    def check(self) -> None:
        """Raise the error of `step` if there was one; after an error there are no more steps."""
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            while (wait_s := self._step()) is not None and not self._stop.wait(wait_s):
                continue
        except BaseException as error:  # noqa: BLE001 (raised in the thread that leaves the context)
            self._error = error


def self_steered_motions(
    robots: Mapping[RobotKey, EmulatedRobot], path_starts_ns: Mapping[RobotKey, int]
) -> dict[RobotKey, RecordedMotion]:
    """Return the current motion of each robot that has steered itself since the lab assigned its last path.

    Args:
        robots: The robots.
        path_starts_ns: Start of each robot's last assigned path; motion that refers to an earlier path is ignored.
    """
    now_ns = time.monotonic_ns()
    motions = {key: robot.recorded_motion() for key, robot in robots.items()}
    return {
        key: motion.at(now_ns) if motion.is_moving else motion
        for key, motion in motions.items()
        if motion is not None and motion.path_start_ns == path_starts_ns.get(key)
    }


class PlacesRobots(Protocol):
    """The part of a medium, or of several media, that places robots."""

    def place(
        self,
        positions_m: Mapping[str, Vector],
        *,
        relay: str | None = None,
        velocities_m_s: Mapping[str, Vector] = ...,
        attitudes: Mapping[str, Attitude] = ...,
    ) -> None:
        """Place the robots. The arguments are those of `MediumClient.place`."""


class Mobility:
    """Places robots, moves them, and moves one out of range.

    Args:
        cast: The robot of each role.
        media: The media that carry the robots' packets.
        world: The world around the robots.
        laptop: The operator's laptop, placed beside the robots; None if it is not on the air.
        robots: Handles of the robots, which receive their paths and report their motion if they steer themselves.
        write_positions: Called with the positions of the laptop and of the robots that are not out of range, metres
            east, north, up, for the laser scanners of other robots.
    """

    def __init__(
        self,
        cast: Cast,
        media: PlacesRobots,
        world: World,
        laptop: Laptop | None,
        robots: Mapping[Role, EmulatedRobot] = MappingProxyType({}),
        *,
        write_positions: Callable[[Mapping[str, Vector]], None] = lambda positions_m: None,  # noqa: ARG005
    ) -> None:
        self._write_positions = write_positions
        self._robots = robots
        self._cast = cast
        self._media = media
        self._world = world
        self._laptop = laptop
        self._placement: Placement | None = None
        self._out_of_range_role: Role | None = None
        # The motions, each with its start time on the monotonic clock.
        self._motions: list[tuple[int, Motion]] = []
        # Start of each robot's last assigned path; motion that refers to an earlier path is ignored.
        self._path_starts_ns: dict[Role, int] = {}
        self._last_motions: dict[Role, RecordedMotion] = {}
        self._track: list[TrackPoint] = []
        self._attitudes: dict[str, Attitude] = {}
        # Each motion runs in a separate thread.
        self._lock = threading.RLock()

    def place(self, placement: Placement) -> None:
        """Move all robots to their positions, immediately.

        Raises:
            ConfigurationError: The world has no line for the scenario.
            LinkError: The medium process or a robot exited or did not answer.
            RobotError: A kernel call of a robot failed.
        """
        with self._lock:
            self._placement = placement
            # The robots are updated before the medium: the new path invalidates motion that refers to the old one.
            # A move without legs puts a robot at its place in the placement; its speed has no effect.
            for role in self._robots:
                self._send_path(Move(role, (), speed_m_s=1.0), time.monotonic_ns())
            self._update_medium()

    def return_to_place(self, role: Role) -> None:
        """Move one robot back to its position, immediately. Raises the errors of `moving`."""
        with self._lock:
            self._send_path(Move(role, (), speed_m_s=1.0), time.monotonic_ns())
            self._update_medium()

    def set_out_of_range(self, role: Role | None) -> None:
        """Move one robot out of the range of all others, or move it back with None.

        If the relay is out of range, no robot receives packets of another robot.

        Raises:
            LinkError: The medium process exited or did not answer.
            RobotError: The robots have not been placed yet.
        """
        with self._lock:
            self._require_placement()
            self._out_of_range_role = role
            self._update_medium()

    @contextmanager
    def moving(self, move: Move) -> Iterator[None]:
        """Move a robot while the body runs; then move it back to its position, even after an error.

        Raises:
            LinkError: The medium process or the robot exited or did not answer.
            RobotError: The robots have not been placed yet, or a kernel call of the robot failed.
        """
        motion = positions.motion(self._cast, self._require_placement(), move, self._world)
        entry = time.monotonic_ns(), motion
        with self._lock:
            self._motions.append(entry)
        try:
            self._send_path(move, entry[0])
            with MotionThread(self._update_medium):
                yield
        finally:
            with self._lock:
                self._motions.remove(entry)
                self._update_medium()
            self._send_path(Move(move.role, (), move.speed_m_s), time.monotonic_ns())

    def watching(self) -> AbstractContextManager[object]:
        """Return a context in which the medium receives the positions of robots that steer themselves."""
        if not any(robot.spec.steers for robot in self._robots.values()):
            return nullcontext()
        return MotionThread(self._watch, "watch")

    def _watch(self) -> float:
        """Update the medium if a robot has moved itself; return the seconds until the next call."""
        with self._lock:
            motions = self._self_steered_motions()
            if motions == self._last_motions and not any(motion.is_moving for motion in motions.values()):
                return WATCH_S
            self._last_motions = motions
            self._update_medium()
            fastest_m_s = max((math.hypot(*motion.velocity_m_s) for motion in motions.values()), default=0.0)
            return min(max(STEP_M / fastest_m_s, _MIN_PERIOD_S), WATCH_S) if fastest_m_s else WATCH_S

    def _self_steered_motions(self) -> dict[Role, RecordedMotion]:
        return self_steered_motions(self._robots, self._path_starts_ns)

    def track(self, since_utc_ns: int) -> tuple[TrackPoint, ...]:
        """Return the track points after a time, and the last point of each robot until then; discard older points."""
        with self._lock:
            first_kept = {
                point.role: number for number, point in enumerate(self._track) if point.utc_ns <= since_utc_ns
            }
            self._track = [
                point for number, point in enumerate(self._track) if number >= first_kept.get(point.role, 0)
            ]
            return tuple(self._track)

    def _send_path(self, move: Move, start_ns: int) -> None:
        """Send a robot the path of a move, if the placement includes its role."""
        placement = self._require_placement()
        if move.role in self._robots and move.role in geometry.positions_m(placement):
            self._path_starts_ns[move.role] = start_ns
            self._robots[move.role].move(positions.assigned_path(placement, move, self._world, start_ns))

    def _require_placement(self) -> Placement:
        if self._placement is None:
            raise RobotError("the robots have not been placed yet", remedy="place them first")
        return self._placement

    def _update_medium(self) -> float | None:
        """Send the medium all positions; return the seconds until the next update, or None without motion."""
        with self._lock:
            placement = self._require_placement()
            # The track gets the time of the positions, because the medium's answer may take long on a busy machine.
            now_ns, utc_ns = time.monotonic_ns(), time.time_ns()
            positions_m = positions.positions_m(self._cast, placement, self._world)
            states = {name: State(position_m) for name, position_m in positions_m.items()}
            for role, robot in self._cast.items():
                if (state := states.get(robot.name)) is not None:
                    heading_rad = positions.facing_rad(placement, role, self._world)
                    states[robot.name] = state._replace(heading_rad=heading_rad)
            for start_ns, motion in self._motions:
                states |= motion.at(now_ns - start_ns)
            states |= {
                self._cast[role].name: self._self_steered_state(role, motion)
                for role, motion in self._self_steered_motions().items()
            }
            relay = positions.relay(self._cast, placement)
            if self._laptop is not None:
                states[self._laptop.name] = State(positions.laptop_m(self._cast, placement, self._world))
            hidden_robot = None if self._out_of_range_role is None else self._cast[self._out_of_range_role].name
            visible_states = {name: state for name, state in states.items() if name != hidden_robot}
            self._write_positions({name: state.position_m for name, state in visible_states.items()})
            if hidden_robot is not None:
                states = {} if hidden_robot == relay else visible_states
            self._attitudes = {
                name: attitude_of(state, before=self._attitudes.get(name, Attitude()))
                for name, state in states.items()
            }
            self._media.place(
                {name: state.position_m for name, state in states.items()},
                relay=relay if relay in states else None,
                velocities_m_s={name: state.velocity_m_s for name, state in states.items()},
                attitudes=self._attitudes,
            )
            self._extend_track(utc_ns, states)
            return self._next_update_s(now_ns, states)

    def _extend_track(self, utc_ns: int, states: Mapping[str, State]) -> None:
        """Append a point for each robot that has none, or whose position or velocity has changed since its last one.

        A robot that is not in `states` is off the air: its point has no position. `utc_ns` is the time of `states`.
        """
        last_points = {point.role: point for point in self._track}
        for role, robot in self._cast.items():
            state = states.get(robot.name)
            current = (None, STILL) if state is None else (state.position_m, state.velocity_m_s)
            last_point = last_points.get(role)
            if last_point is None or (last_point.position_m, last_point.velocity_m_s) != current:
                self._track.append(TrackPoint(utc_ns, role, *current))

    def _self_steered_state(self, role: Role, motion: RecordedMotion) -> State:
        """Return the state of a robot that steers itself; a ground robot is at the height of the ground."""
        flies = mavlink_of(self._cast[role].profile) is not None
        return motion.state if flies else positions.on_ground(motion.state, self._world)

    def _next_update_s(self, now_ns: int, states: Mapping[str, State]) -> float | None:
        """Return the seconds until the next update of the medium, or None if all motions have ended."""
        remaining_ns = [
            math.inf if motion.end_ns is None else start_ns + motion.end_ns - now_ns
            for start_ns, motion in self._motions
        ]
        if all(duration_ns <= 0 for duration_ns in remaining_ns):
            return None
        fastest_m_s = max((math.hypot(*state.velocity_m_s) for state in states.values()), default=0.0)
        step_s = STEP_M / fastest_m_s if fastest_m_s else _MAX_PERIOD_S
        next_end_s = min(duration_ns for duration_ns in remaining_ns if duration_ns > 0) / 1e9
        return min(max(step_s, _MIN_PERIOD_S), _MAX_PERIOD_S, next_end_s)
