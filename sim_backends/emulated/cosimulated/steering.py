"""Steering of one robot: reads the commands of its programs, and writes the record of its motion."""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from typing_extensions import override

from sim_backends.emulated.robot.base_controller import TIMEOUT_NS, odometry
from sim_backends.emulated.robot.velocity_command import VelocityCommandRecord
from sim_backends.emulated.ros.flight_records import FlightCommandRecord, FlightMotion, FlightRecord
from sim_backends.emulated.ros.robot_motion import AT_REST, MotionReporter, RobotMotionState
from sim_backends.physics.body import Twist, Velocity
from sim_backends.physics.quadrotor import ROTORS_OFF, FlightStatus, FlightTarget
from sim_backends.world.motion import STILL, State

_REPORT_NS: Final = 10_000_000
"""Interval of the entries in the record while a robot moves; the base controller in a robot uses 20 ms."""

_PENDING_COMMANDS: Final = 1000
"""Maximum number of commands that are kept while the simulation lags (at most 1 s); older ones are dropped."""

Command = Twist | FlightTarget


class TimedCommand(NamedTuple):
    """A command.

    Attributes:
        time_ns: Its time, from the monotonic clock.
        command: Velocity of a robot on wheels, or target of a drone's flight.
        is_idle: True if it switches the rotors off. Such a command need not be repeated, and is ignored if it is the
            first one after the lab has placed the robot.
    """

    time_ns: int
    command: Command
    is_idle: bool = False


class Steering(ABC):
    """Reads the commands of one robot and records its motion. Times are those of the monotonic clock.

    Args:
        motion_record: Descriptor of the record of the robot's motion.
        paths: Descriptor of the file of its assigned paths.
        now_ns: The current time.

    Attributes:
        idle: The command that is applied if the last command has not been repeated for `TIMEOUT_NS`.
        is_driven: True if the robot has received a command since the lab last placed it.
        is_placed: True if the lab has placed it.
        is_at_rest: True if the last entry of its record states that it is at rest, and no command is active; also
            before the first command after the lab has placed it.
    """

    idle: Command

    def __init__(self, motion_record: int, paths: int, now_ns: int) -> None:
        self._last_command_ns = now_ns
        self._pending: deque[TimedCommand] = deque(maxlen=_PENDING_COMMANDS)
        self._reporter = MotionReporter(_path(paths), _path(motion_record), now_ns)
        self.is_driven = False
        # Motion of the robot when the lab last placed it.
        self._start: RobotMotionState = AT_REST
        self.is_placed = False
        # Time at which `idle` is applied unless another command arrives; None if no command is active.
        self._stop_due_ns: int | None = None
        # Time and heading of the last entry.
        self._last_report: tuple[int, float] | None = None
        self.is_at_rest = True

    @abstractmethod
    def _read_command(self) -> TimedCommand | None:
        """Return the last command of the robot's programs, or None if there is none."""

    def poll_placement(self, now_ns: int) -> RobotMotionState | None:
        """Return the state of the robot, at rest, if the lab has placed it since the last call, or None.

        Earlier commands are dropped.
        """
        placement = self._reporter.poll_placement(now_ns)
        if placement is not None:
            self._start, self.is_placed = placement, True
            self._last_command_ns = now_ns
            self._pending.clear()
            self.is_driven, self._stop_due_ns, self._last_report, self.is_at_rest = False, None, None, True
        return placement

    @property
    def heading_rad(self) -> float:
        """Heading of the robot when the lab last placed it."""
        return self._start.heading_rad

    def commands(self, until_ns: int) -> Iterator[tuple[int, Command]]:
        """Yield the commands up to a time, each with its time.

        `idle` is yielded at the time at which the last command has not been repeated for `TIMEOUT_NS`. If the
        simulation lags behind real time, the programs may have sent commands with times after `until_ns`. These are
        kept for later calls.
        """
        newest = self._read_command()
        if newest is not None and self._last_command_ns < newest.time_ns and self.is_placed:
            self._last_command_ns = newest.time_ns
            self._pending.append(newest)
        while self._pending and self._pending[0].time_ns <= until_ns:
            time_ns, command, is_idle = self._pending.popleft()
            yield from self._stop_until(time_ns)
            if is_idle and not self.is_driven:
                continue
            self._stop_due_ns = None if is_idle else time_ns + TIMEOUT_NS
            self.is_driven, self.is_at_rest = True, False
            yield time_ns, command
        yield from self._stop_until(until_ns)

    def _stop_until(self, until_ns: int) -> Iterator[tuple[int, Command]]:
        """Yield `idle` with its time if it is due at or before a time."""
        if self._stop_due_ns is not None and self._stop_due_ns <= until_ns:
            yield self._stop_due_ns, self.idle
            self._stop_due_ns = None

    def is_report_due(self, at_ns: int) -> bool:
        """Return True if the motion at a time must be recorded. A robot at rest is recorded only once."""
        return not self.is_at_rest and (self._last_report is None or at_ns - self._last_report[0] >= _REPORT_NS)

    def report(self, at_ns: int, state: State, flight: FlightStatus | None = None) -> None:
        """Record the motion of a robot that is driven, if a record is due.

        Args:
            at_ns: Time of the state.
            state: Position of its antenna, velocity and heading.
            flight: Position and attitude of a drone, and whether it is on the ground or an obstacle; None for
                other robots.
        """
        if not self.is_report_due(at_ns):
            return
        before_ns, before_rad = (at_ns, self._start.heading_rad) if self._last_report is None else self._last_report
        heading_rad = before_rad + math.remainder((state.heading_rad or 0.0) - before_rad, math.tau)
        turn_rad_s = 0.0
        if at_ns > before_ns:
            turn_rad_s = (heading_rad - before_rad) * 1e9 / (at_ns - before_ns)
            if abs(turn_rad_s) < _NO_TURN_RAD_S:
                turn_rad_s = 0.0
        self._last_report = at_ns, heading_rad
        is_still = math.hypot(*state.velocity_m_s) < _STILL_M_S and (flight is None or flight.is_supported)
        self.is_at_rest = is_still and not turn_rad_s and self._stop_due_ns is None
        if is_still:
            state = state._replace(velocity_m_s=STILL)
        self._write(at_ns, state, heading_rad, turn_rad_s, flight)

    def _write(
        self,
        at_ns: int,
        state: State,
        heading_rad: float,
        turn_rad_s: float,
        flight: FlightStatus | None,  # noqa: ARG002 (see FlightSteering)
    ) -> None:
        self._reporter.write(
            at_ns,
            state.position_m,
            state.velocity_m_s,
            heading_rad=heading_rad,
            turn_rad_s=turn_rad_s,
            odometry=odometry(self._start, state.position_m, heading_rad),
        )


class GroundSteering(Steering):
    """Steering of a robot on wheels.

    Args:
        descriptors: Descriptors (`EmulatedRobot.physics_fds`) of the record of its motion, the file of its assigned
            paths, and the record of its velocity commands.
        now_ns: The current time.
    """

    idle = Twist()

    def __init__(self, descriptors: Sequence[int], now_ns: int) -> None:
        motion_record, paths, command_record = descriptors
        super().__init__(motion_record, paths, now_ns)
        self._command_record = VelocityCommandRecord(command_record)

    @override
    def _read_command(self) -> TimedCommand | None:
        command = self._command_record.read()
        if command is None:
            return None
        return TimedCommand(command.time_ns, Twist(command.forward_m_s, command.turn_rad_s))


class FlightSteering(Steering):
    """Steering of a drone by its autopilot; without commands its rotors are off, so that it falls.

    Args:
        descriptors: Descriptors (`EmulatedRobot.physics_fds`) of the record of its motion, the file of its assigned
            paths, the record of the autopilot's commands, and the record of its flight.
        now_ns: The current time.
    """

    idle = ROTORS_OFF

    def __init__(self, descriptors: Sequence[int], now_ns: int) -> None:
        motion_record, paths, command_record, flight_record = descriptors
        super().__init__(motion_record, paths, now_ns)
        self._command_record = FlightCommandRecord(command_record)
        self._flight_record = FlightRecord(flight_record)

    @override
    def _read_command(self) -> TimedCommand | None:
        command = self._command_record.read()
        if command is None or command.path_start_ns != self._reporter.path_start_ns:
            return None
        if not command.powered:
            return TimedCommand(command.time_ns, ROTORS_OFF, is_idle=True)
        velocity = Velocity(command.velocity_m_s, command.yaw_rad)
        return TimedCommand(command.time_ns, FlightTarget(velocity, command.acceleration_m_s2, command.climb_m_s2))

    @override
    def _write(
        self, at_ns: int, state: State, heading_rad: float, turn_rad_s: float, flight: FlightStatus | None
    ) -> None:
        super()._write(at_ns, state, heading_rad, turn_rad_s, flight)
        if flight is None:
            return
        place_m, roll_rad, pitch_rad, is_supported = flight
        self._flight_record.write(
            FlightMotion(
                at_ns,
                self._reporter.path_start_ns,
                is_supported,
                place_m,
                state.velocity_m_s,
                heading_rad,
                turn_rad_s,
                roll_rad,
                pitch_rad,
            )
        )


_STILL_M_S: Final = 1e-3
_NO_TURN_RAD_S: Final = 1e-3
"""A robot that moves and turns more slowly counts as at rest, because contacts in MuJoCo never keep it exactly
still."""


def _path(fd: int) -> Path:
    """Return a path that opens the file of a descriptor again, even if the file is in another mount namespace."""
    return Path(f"/proc/self/fd/{fd}")
