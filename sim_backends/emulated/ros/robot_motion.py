"""Motion of an emulated robot, which its sensors measure: wheel odometry and position.

The lab sends a path only once, when the motion starts. The robot then computes its position on the path, so no
position message can be late. The wheels do not turn when the lab moves a robot back to its place, so the odometry
continues from its last value.

Some robots steer themselves. The process that steers such a robot (a base controller or an autopilot) uses a
`MotionReporter`: it reads the position at which the lab has last placed the robot, computes the motion from there,
and writes it to a record. The robot's sensors read this record, and the lab passes it to the medium. The lab may
place the robot at another position at any time; records that refer to an earlier path are then ignored.
"""

import json
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.assigned_path import AssignedPath
from sim_backends.emulated.ros.motion_record import MotionRecord, RecordedMotion
from sim_backends.world.motion import LEVEL, STILL, WayPoints


@dataclass(frozen=True)
class RobotMotionState:
    """State of the motion of a robot at one time.

    Attributes:
        x_m: Odometry: distance ahead of the point where the robot was switched on, along its heading at that time.
        y_m: Odometry: distance to the left of that heading.
        yaw_rad: Odometry: angle to the left of that heading.
        speed_m_s: Forward speed.
        position_m: Position, metres east, north, up.
        heading_rad: Heading, from east towards north.
        turn_rad_s: Turn rate to the left; 0 on an assigned path, where the robot turns in zero time.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    speed_m_s: float = 0.0
    position_m: Vector = (0.0, 0.0, 0.0)
    heading_rad: float = 0.0
    turn_rad_s: float = 0.0


AT_REST: Final = RobotMotionState()


class Odometer:
    """Odometry of a robot, which starts at 0 when the object is created.

    While a robot steers itself, its odometry is read from its motion record, and may have started earlier.

    Args:
        paths_file: The file of assigned paths, which may be missing.
        now_ns: Time of the start, from the monotonic clock.
        motion_record: The file with the recorded motion of a robot that steers itself; None for other robots.
    """

    def __init__(self, paths_file: Path, now_ns: int, motion_record: Path | None = None) -> None:
        self._paths_file = paths_file
        self._record = None if motion_record is None else MotionRecord.open(motion_record)
        self._read_bytes = 0
        self._path: AssignedPath | None = None
        # Motion of the robot when its last path started. `_read_paths` reads and changes this value. It is reset
        # afterwards, because the odometry does not include motion before the creation of this object.
        self._base = AT_REST
        self._read_paths(now_ns)
        self._base = AT_REST
        # If the robot is already on a path, the odometry starts at 0 at its current position on the path.
        if self._path is not None:
            motion = _motion_on(self._path, AT_REST, now_ns)
            yaw_rad = -motion.yaw_rad
            x_m, y_m = _rotate(motion.x_m, motion.y_m, yaw_rad)
            self._base = RobotMotionState(-x_m, -y_m, yaw_rad)

    def at(self, now_ns: int) -> RobotMotionState:
        """Return the robot's motion at a time, which must not be earlier than the time of the last call."""
        self._read_paths(now_ns)
        return self._recorded_motion(now_ns) or self._assigned_motion(now_ns)

    @property
    def path_start_ns(self) -> int:
        """Start of the last assigned path, 0 if there is none."""
        return 0 if self._path is None else self._path.start_ns

    def _recorded_motion(self, now_ns: int) -> RobotMotionState | None:
        """Return the recorded motion, or None if the robot has not steered itself since its last assigned path."""
        last = None if self._record is None else self._record.read()
        if last is None or last.path_start_ns != self.path_start_ns:
            return None
        current = last.at(now_ns)
        # `RecordedMotion.at` turns the heading but not the velocity, so the speed is read from the record.
        speed_m_s = last.speed_m_s if current.is_moving else 0.0
        return RobotMotionState(
            *current.odometry, speed_m_s, current.position_m, current.heading_rad, current.turn_rad_s
        )

    def _assigned_motion(self, now_ns: int) -> RobotMotionState:
        """Return the motion on the last assigned path."""
        return self._base if self._path is None else _motion_on(self._path, self._base, now_ns)

    def _read_paths(self, now_ns: int) -> None:
        """Read the paths that the lab has appended since the last call."""
        try:
            if self._paths_file.stat().st_size == self._read_bytes:
                return
            with self._paths_file.open("rb") as file:
                file.seek(self._read_bytes)
                data = file.read()
        except FileNotFoundError:
            return
        complete = data[: data.rfind(b"\n") + 1]
        self._read_bytes += len(complete)
        for line in complete.splitlines():
            path = AssignedPath(**json.loads(line))
            change_ns = min(path.start_ns, now_ns)
            self._base = self._recorded_motion(change_ns) or self._assigned_motion(change_ns)
            self._path = path


def _motion_on(path: AssignedPath, base: RobotMotionState, now_ns: int) -> RobotMotionState:
    """Return a robot's motion on a path at a time; `base` is its motion when the path started."""
    elapsed_ns = now_ns - path.start_ns
    points_m = [(point_m[0], point_m[1], 0.0) for point_m in path.points_m]  # `speed_m_s` is the horizontal speed
    (east_m, north_m, _), velocity_m_s, _ = WayPoints("", points_m, path.speed_m_s).at(elapsed_ns)[""]
    heading_rad = path.facing_rad
    if velocity_m_s != STILL:
        heading_rad = math.atan2(velocity_m_s[1], velocity_m_s[0])
    elif elapsed_ns > 0 and len(points_m) > 1:
        previous_m, last_m = points_m[-2:]
        heading_rad = math.atan2(last_m[1] - previous_m[1], last_m[0] - previous_m[0])
    x_m, y_m = _rotate(east_m - points_m[0][0], north_m - points_m[0][1], base.yaw_rad - path.facing_rad)
    return RobotMotionState(
        base.x_m + x_m,
        base.y_m + y_m,
        base.yaw_rad + math.remainder(heading_rad - path.facing_rad, 2 * math.pi),
        math.hypot(*velocity_m_s[:2]),
        (east_m, north_m, _height_m(path, elapsed_ns)),
        heading_rad,
    )


def _height_m(path: AssignedPath, elapsed_ns: int) -> float:
    """Return the height of a robot, interpolated between the points of its path."""
    remaining_m = max(elapsed_ns, 0) / 1e9 * path.speed_m_s
    for start_m, end_m in pairwise(path.points_m):
        length_m = math.dist(start_m[:2], end_m[:2])
        if remaining_m < length_m:
            return start_m[2] + remaining_m / length_m * (end_m[2] - start_m[2])
        remaining_m -= length_m
    return path.points_m[-1][2]


def _rotate(x: float, y: float, angle_rad: float) -> tuple[float, float]:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return cos * x - sin * y, sin * x + cos * y


class MotionReporter:
    """Reads the positions at which the lab places a robot, and records the motion of the robot.

    Only the process that steers the robot may create one.

    Args:
        paths: The file of the paths that the lab assigns (`assigned_path.append_path`).
        record: The file in which the robot records its motion.
        now_ns: Time of creation, from the monotonic clock.

    Raises:
        OSError: The record cannot be created.
    """

    def __init__(self, paths: Path, record: Path, now_ns: int) -> None:
        self._record = MotionRecord.open(record)
        self._odometer = Odometer(paths, now_ns, record)
        self._path_start_ns: int | None = None

    @property
    def path_start_ns(self) -> int:
        """Start time of the path with which the lab last placed the robot; 0 if none has been read."""
        return self._path_start_ns or 0

    def poll_placement(self, now_ns: int) -> RobotMotionState | None:
        """Return the motion at the position where the lab has placed the robot since the last call, or None.

        The first call returns the current motion of the robot, even if the process has been restarted.

        Args:
            now_ns: Time from the monotonic clock; must not decrease from call to call.
        """
        motion = self._odometer.at(now_ns)
        if self._odometer.path_start_ns == self._path_start_ns:
            return None
        self._path_start_ns = self._odometer.path_start_ns
        return motion

    def write(
        self,
        now_ns: int,
        position_m: Vector,
        velocity_m_s: Vector = STILL,
        *,
        heading_rad: float = 0.0,
        turn_rad_s: float = 0.0,
        odometry: Vector = (0.0, 0.0, 0.0),
        tilt_rad: tuple[float, float] = LEVEL,
    ) -> None:
        """Record the robot's position and motion. The arguments are the attributes of `RecordedMotion`.

        Call it at least ten times a second while the robot moves, because a robot without a new record for
        `motion_record.SILENT_NS` counts as stopped. Call it once after the robot has stopped.

        Raises:
            OSError: There is no space for the record.
        """
        self._record.write(
            RecordedMotion(
                now_ns, self.path_start_ns, position_m, velocity_m_s, heading_rad, turn_rad_s, odometry, tilt_rad
            )
        )
