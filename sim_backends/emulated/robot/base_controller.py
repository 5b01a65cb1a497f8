"""Base controller of an emulated ground robot: computes its pose from commanded velocities, within limits.

Like ROS's `diff_drive_controller` and the firmware of a TurtleBot3, it limits the commanded velocity, and stops if no
command arrives for `TIMEOUT_NS`. It uses the differential drive of the co-simulation's physics, without collisions.
"""

import math
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.robot.spec import Base
from sim_backends.emulated.ros.robot_motion import AT_REST, RobotMotionState
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import DifferentialDrive, DrivePose
from sim_backends.physics.robot_limits import DriveLimits

TIMEOUT_NS: Final = 500_000_000
"""Time from the last commanded velocity until the base stops: CONTROL_MOTOR_TIMEOUT of OpenCR's turtlebot3_core, and
ROS's default."""

STEP_NS: Final = 10_000_000
"""Time step of the motion."""
_TURN_RISE_S: Final = 0.5
"""Time in which the turn rate rises from 0 to its limit."""


def odometry(start: RobotMotionState, position_m: Vector, heading_rad: float) -> Vector:
    """Return the odometry of a robot after a motion.

    Odometry is the pose relative to where the robot was switched on: metres ahead, metres to the left, and the angle
    to the left in radians.

    Args:
        start: State of motion of the robot at the start of the motion.
        position_m: Its position, metres east, north, up.
        heading_rad: Its heading, continuous over full turns.
    """
    x_m, y_m = position_m[0] - start.position_m[0], position_m[1] - start.position_m[1]
    rotation_rad = start.yaw_rad - start.heading_rad
    cos, sin = math.cos(rotation_rad), math.sin(rotation_rad)
    yaw_rad = start.yaw_rad + heading_rad - start.heading_rad
    return start.x_m + cos * x_m - sin * y_m, start.y_m + sin * x_m + cos * y_m, yaw_rad


class BaseController:
    """Base of one robot; the caller provides the time and the velocities.

    Args:
        base: Limits of the base.
        now_ns: Time of creation; all times are those of the monotonic clock.
    """

    def __init__(self, base: Base, now_ns: int) -> None:
        limits = DriveLimits(
            base.speed_m_s,
            base.acceleration_m_s2,
            base.turn_rad_s,
            base.turn_rad_s / _TURN_RISE_S,
            radius_m=0.0,
            height_m=0.0,
        )
        self._drive = DifferentialDrive(limits, (0.0, 0.0))
        self._now_ns = now_ns
        self._commanded_ns: int | None = None
        self._command = Twist()
        self.reset(AT_REST)

    @property
    def pose(self) -> DrivePose:
        """Pose and speeds of the robot."""
        return self._pose

    @property
    def is_idle(self) -> bool:
        """True if the robot is at rest and no commanded velocity is active."""
        return self._commanded_ns is None and not (self._pose.speed_m_s or self._pose.turn_rad_s)

    @property
    def odometry(self) -> tuple[float, float, float]:
        """Odometry of the current pose, as the function `odometry` returns it."""
        return odometry(self._start, self._pose.place_m, self._pose.heading_rad)

    def reset(self, motion: RobotMotionState) -> None:
        """Start again at rest where the lab has placed the robot; earlier velocities are dropped."""
        self._start = motion
        self._pose = DrivePose(motion.position_m, motion.heading_rad)
        self._commanded_ns = None

    def set_velocity(self, now_ns: int, ahead_m_s: float, turn_rad_s: float) -> None:
        """Set the commanded velocity; values that are not finite are ignored."""
        if math.isfinite(ahead_m_s) and math.isfinite(turn_rad_s):
            if self.is_idle:
                self._now_ns = now_ns
            self._command, self._commanded_ns = Twist(ahead_m_s, turn_rad_s), now_ns

    def advance(self, now_ns: int) -> None:
        """Advance the pose to this time, in whole steps."""
        while self._now_ns + STEP_NS <= now_ns:
            if self.is_idle:
                self._now_ns += (now_ns - self._now_ns) // STEP_NS * STEP_NS
                return
            self._now_ns += STEP_NS
            if self._commanded_ns is not None and self._now_ns - self._commanded_ns > TIMEOUT_NS:
                self._commanded_ns = None
            command = Twist() if self._commanded_ns is None else self._command
            self._pose = self._drive.course(self._pose, command, STEP_NS / 1e9).at(1)  # the pose after one step
