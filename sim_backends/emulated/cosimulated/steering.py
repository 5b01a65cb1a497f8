"""Steering of one robot: reads the velocities that its programs command, and writes the record of its motion."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from sim_backends.emulated.robot.base_controller import TIMEOUT_NS, odometry
from sim_backends.emulated.robot.commanded import Commanded, CommandedRecord
from sim_backends.emulated.ros.own_motion import AT_REST, MotionReporter, OwnMotion
from sim_backends.physics.body import Twist
from sim_backends.world.motion import STILL, State

_REPORT_NS: Final = 10_000_000
"""Interval of the records while a robot moves: those of the robot's own base controller have 20 ms."""

_PENDING_COMMANDS: Final = 1000
"""Velocities that are kept while the simulation lags, by at most 1 s; older ones are dropped."""


class Steering:
    """Commands and record of one robot. Times are those of the monotonic clock.

    Args:
        descriptors: Of the record of its motion, the file of its assigned paths, and the record of its commanded
            velocity (`EmulatedRobot.physics_fds`).
        now_ns: The present time.

    Attributes:
        is_driven: True if the robot was commanded since the lab put it at its place.
        is_placed: True if the lab has put it at a place.
        rests: True if it is at rest, no commanded velocity is active, and this is recorded.
    """

    def __init__(self, descriptors: Sequence[int], now_ns: int) -> None:
        steered, paths, commanded = descriptors
        self._commands = CommandedRecord(commanded)
        self._seen_ns = now_ns
        self._pending: deque[Commanded] = deque(maxlen=_PENDING_COMMANDS)
        self._reporter = MotionReporter(_path(paths), _path(steered), now_ns)
        self.is_driven = False
        self._start: OwnMotion = AT_REST
        self.is_placed = False
        self._stops_ns: int | None = None
        self._reported: tuple[int, float] | None = None
        self.rests = True

    def poll_placement(self, now_ns: int) -> OwnMotion | None:
        """Return the place at which the lab has put the robot since the last call, or None if it has not.

        It is at rest there, and earlier velocities are dropped.
        """
        placed = self._reporter.poll_placement(now_ns)
        if placed is not None:
            self._start, self.is_placed = placed, True
            self._seen_ns = now_ns
            self._pending.clear()
            self.is_driven, self._stops_ns, self._reported, self.rests = False, None, None, True
        return placed

    @property
    def heading_rad(self) -> float:
        """Heading at the place at which the lab put the robot."""
        return self._start.heading_rad

    def commands(self, until_ns: int) -> Iterator[tuple[int, Twist]]:
        """Yield the times and velocities that were commanded until a time, and the stop after a missing command.

        A simulation that lags behind reads velocities that it has not reached; they are kept until then.
        """
        commanded = self._commands.read()
        if commanded is not None and self._seen_ns < commanded.time_ns and self.is_placed:
            self._seen_ns = commanded.time_ns
            self._pending.append(commanded)
        while self._pending and self._pending[0].time_ns <= until_ns:
            commanded = self._pending.popleft()
            yield from self._stop_until(commanded.time_ns)
            self._stops_ns = commanded.time_ns + TIMEOUT_NS
            self.is_driven, self.rests = True, False
            yield commanded.time_ns, Twist(commanded.forward_m_s, commanded.turn_rad_s)
        yield from self._stop_until(until_ns)

    def _stop_until(self, until_ns: int) -> Iterator[tuple[int, Twist]]:
        """Yield the stop after a missing command if it is due at a time."""
        if self._stops_ns is not None and self._stops_ns <= until_ns:
            yield self._stops_ns, Twist()
            self._stops_ns = None

    def report(self, at_ns: int, state: State) -> None:
        """Record the motion of a robot that is driven; a robot that has stopped is recorded once.

        Args:
            at_ns: Time of the state.
            state: Position of its antenna, velocity and heading.
        """
        if self.rests or (self._reported is not None and at_ns - self._reported[0] < _REPORT_NS):
            return
        before_ns, before_rad = (at_ns, self._start.heading_rad) if self._reported is None else self._reported
        heading_rad = before_rad + math.remainder((state.heading_rad or 0.0) - before_rad, math.tau)
        turn_rad_s = 0.0
        if at_ns > before_ns:
            turn_rad_s = (heading_rad - before_rad) * 1e9 / (at_ns - before_ns)
            if abs(turn_rad_s) < _NO_TURN_RAD_S:
                turn_rad_s = 0.0
        self._reported = at_ns, heading_rad
        is_still = math.hypot(*state.velocity_m_s) < _STILL_M_S
        self.rests = is_still and not turn_rad_s and self._stops_ns is None
        self._reporter.write(
            at_ns,
            state.position_m,
            STILL if is_still else state.velocity_m_s,
            heading_rad=heading_rad,
            turn_rad_s=turn_rad_s,
            odometry=odometry(self._start, state.position_m, heading_rad),
        )


_STILL_M_S: Final = 1e-3
_NO_TURN_RAD_S: Final = 1e-3
"""Slower motions are those of a simulated contact: in MuJoCo a stationary robot is never exactly at rest."""


def _path(fd: int) -> Path:
    """Return a path that opens the file of a descriptor again, also one of another mount namespace."""
    return Path(f"/proc/self/fd/{fd}")
