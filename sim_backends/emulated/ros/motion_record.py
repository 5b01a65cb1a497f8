"""Record of the motion of a robot that steers itself. The robot's sensors and the lab read it.

One process of a robot writes it: its base controller, or its autopilot. Each record has the position, the velocity
and a time of the monotonic clock, which all processes of a machine share. Readers extrapolate the motion.
"""

import math
from typing import Any, Final, NamedTuple

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.slots import Record
from sim_backends.world.motion import LEVEL, STILL, State, TiltedState

SILENT_NS: Final = 500_000_000
"""A robot that has not written a record for this long counts as stopped. A moving robot writes much more often."""

_LAYOUT: Final = "2q13d"


class RecordedMotion(NamedTuple):
    """Motion of a robot that steers itself, at one time.

    Attributes:
        time_ns: The time, from the monotonic clock.
        path_start_ns: Start time of the path (`AssignedPath.start_ns`) with which the lab placed the robot before
            this motion; 0 if there was none. If the lab has assigned another path since, the record is invalid.
        position_m: Position, metres east, north, up.
        velocity_m_s: Velocity, east, north, up.
        heading_rad: Heading, from east towards north.
        turn_rad_s: Turn rate to the left.
        odometry: Metres ahead of the point where the robot was switched on, metres to the left of its heading at that
            time, and the angle to the left of that heading in radians.
        tilt_rad: Roll (left side up) and pitch (nose down).
    """

    time_ns: int
    path_start_ns: int
    position_m: Vector
    velocity_m_s: Vector = STILL
    heading_rad: float = 0.0
    turn_rad_s: float = 0.0
    odometry: Vector = (0.0, 0.0, 0.0)
    tilt_rad: tuple[float, float] = LEVEL

    @property
    def speed_m_s(self) -> float:
        """Forward speed, below 0 if the robot drives backwards."""
        east, north, _ = self.velocity_m_s
        return east * math.cos(self.heading_rad) + north * math.sin(self.heading_rad)

    @property
    def state(self) -> State:
        """Position, velocity and attitude as the lab uses them."""
        return TiltedState.of(self.position_m, self.velocity_m_s, self.heading_rad, self.tilt_rad)

    @property
    def is_moving(self) -> bool:
        """True if the robot moves or turns."""
        return self.velocity_m_s != STILL or self.turn_rad_s != 0.0

    def at(self, now_ns: int) -> "RecordedMotion":
        """Return the motion at a later time by dead reckoning. The robot stops `SILENT_NS` after its last record."""
        is_silent = now_ns - self.time_ns >= SILENT_NS
        elapsed_s = min(max(now_ns - self.time_ns, 0), SILENT_NS) / 1e9
        x_m, y_m, yaw_rad = self.odometry
        ahead_m = self.speed_m_s * elapsed_s
        later = self._replace(
            time_ns=max(now_ns, self.time_ns),
            position_m=_extrapolate(self.position_m, self.velocity_m_s, elapsed_s),
            heading_rad=self.heading_rad + self.turn_rad_s * elapsed_s,
            odometry=(
                x_m + ahead_m * math.cos(yaw_rad),
                y_m + ahead_m * math.sin(yaw_rad),
                yaw_rad + self.turn_rad_s * elapsed_s,
            ),
        )
        return later._replace(velocity_m_s=STILL, turn_rad_s=0.0) if is_silent else later


class MotionRecord(Record):
    """The record in a file, with one writer and any number of readers."""

    layout = _LAYOUT

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        self._values: tuple[Any, ...] | None = None
        self._last: RecordedMotion | None = None

    def write(self, motion: RecordedMotion) -> None:
        """Write the robot's motion.

        Raises:
            OSError: There is no space for it.
        """
        self._slots.write(
            motion.time_ns,
            motion.path_start_ns,
            *motion.position_m,
            *motion.velocity_m_s,
            motion.heading_rad,
            motion.turn_rad_s,
            *motion.odometry,
            *motion.tilt_rad,
        )

    def read(self) -> RecordedMotion | None:
        """Return the newest motion, or None if the robot never steered itself.

        Raises:
            OSError: The file cannot be read.
        """
        values = self._slots.read()
        if values is not None and values is not self._values:  # a new object means new values
            self._values, self._last = values, _to_motion(*values)
        return self._last


def _to_motion(time_ns: int, path_start_ns: int, *values: float) -> RecordedMotion:
    position_m, velocity_m_s, odometry = (_vector(values[index : index + 3]) for index in (0, 3, 8))
    heading_rad, turn_rad_s, roll_rad, pitch_rad = (*values[6:8], *values[11:])
    tilt_rad = roll_rad, pitch_rad
    return RecordedMotion(
        time_ns, path_start_ns, position_m, velocity_m_s, heading_rad, turn_rad_s, odometry, tilt_rad
    )


def _extrapolate(position_m: Vector, velocity_m_s: Vector, for_s: float) -> Vector:
    (east_m, north_m, up_m), (east_m_s, north_m_s, up_m_s) = position_m, velocity_m_s
    return east_m + east_m_s * for_s, north_m + north_m_s * for_s, up_m + up_m_s * for_s


def _vector(values: tuple[float, ...]) -> Vector:
    x, y, z = values
    return x, y, z
