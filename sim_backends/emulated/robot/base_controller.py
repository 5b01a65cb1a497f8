"""The base controller of an emulated ground robot: velocities in, a pose out, within limits.

It takes velocities as ROS's `diff_drive_controller` and the firmware of a TurtleBot3 do, and stands where none came
for `TIMEOUT_NS`. What it drives is a differential drive of the co-simulation's physics; it pushes nothing over and
runs into nothing, as the lab knows no collisions.
"""

import math
from typing import Final

from sim_backends.emulated.robot.spec import Base
from sim_backends.emulated.ros.own_motion import AT_REST, OwnMotion
from sim_backends.physics.body import Twist
from sim_backends.physics.differential_drive import DifferentialDrive, DriveLimits, DrivePose

TIMEOUT_NS: Final = 500_000_000
"""Without a velocity for so long it stands: CONTROL_MOTOR_TIMEOUT of OpenCR's turtlebot3_core, and ROS's default."""

STEP_NS: Final = 10_000_000
_TURNS_UP_S: Final = 0.5
"""How long its turning takes to come up to its limit."""


class BaseController:
    """One robot's base; it knows of no clock and no socket.

    Args:
        base: Its limits.
        now_ns: When it is made, by the monotonic clock, as all times that it is told.
    """

    def __init__(self, base: Base, now_ns: int) -> None:
        limits = DriveLimits(
            base.speed_m_s,
            base.acceleration_m_s2,
            base.turn_rad_s,
            base.turn_rad_s / _TURNS_UP_S,
            radius_m=0.0,
            height_m=0.0,
        )
        self._drive = DifferentialDrive(limits, (0.0, 0.0))
        self._now_ns = now_ns
        self._heard_ns: int | None = None
        self._wanted = Twist()
        self.put(AT_REST)

    @property
    def pose(self) -> DrivePose:
        """Where it is, and how it moves."""
        return self._pose

    @property
    def stands(self) -> bool:
        """Whether it stands, and nobody wants it to drive."""
        return self._heard_ns is None and not (self._pose.speed_m_s or self._pose.turn_rad_s)

    @property
    def wheels(self) -> tuple[float, float, float]:
        """What its odometry has counted; see `Steered.wheels`."""
        began, (east_m, north_m, _) = self._began, self._pose.place_m
        x_m, y_m = east_m - began.place_m[0], north_m - began.place_m[1]
        turned_rad = began.yaw_rad - began.heading_rad
        cos, sin = math.cos(turned_rad), math.sin(turned_rad)
        yaw_rad = began.yaw_rad + self._pose.heading_rad - began.heading_rad
        return began.x_m + cos * x_m - sin * y_m, began.y_m + sin * x_m + cos * y_m, yaw_rad

    def put(self, where: OwnMotion) -> None:
        """Begin anew where it was put; it stands there, whatever it was told before."""
        self._began = where
        self._pose = DrivePose(where.place_m, where.heading_rad)
        self._heard_ns = None

    def hear(self, now_ns: int, ahead_m_s: float, turn_rad_s: float) -> None:
        """Take a velocity; what is no number is not heard."""
        if math.isfinite(ahead_m_s) and math.isfinite(turn_rad_s):
            if self.stands:
                self._now_ns = now_ns
            self._wanted, self._heard_ns = Twist(ahead_m_s, turn_rad_s), now_ns

    def advance(self, now_ns: int) -> None:
        """Drive until this moment, as far as whole steps go."""
        while self._now_ns + STEP_NS <= now_ns:
            if self.stands:
                self._now_ns += (now_ns - self._now_ns) // STEP_NS * STEP_NS
                return
            self._now_ns += STEP_NS
            if self._heard_ns is not None and self._now_ns - self._heard_ns > TIMEOUT_NS:
                self._heard_ns = None
            wanted = Twist() if self._heard_ns is None else self._wanted
            self._pose = self._drive.course(self._pose, wanted, STEP_NS / 1e9).at(1)
