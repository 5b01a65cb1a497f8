"""Robots with differential drive, modelled as unicycles with limited speeds and accelerations.

Forward speed and yaw rate approach the commanded values as fast as their limits allow, independently of each other,
as in ROS's `diff_drive_controller`. With a constant acceleration a and yaw rate w, the displacement in a time t is
exact. It is the integral of the speed along the heading, with the origin of time in the middle of the interval. With
the mean speed v, the mean heading h and x = w t / 2, it is

    v t sin(x) / x                            along h, and
    a t^2 / 2 (sin(x) - x cos(x)) / x^2       to the left of h.

If the yaw rate changes while the robot moves, the displacement is a Fresnel integral; a single step with the mean yaw
rate is then used, with an error below v (dw/dt) t^3 / 12. A turn on a slope is also computed in single steps, because
the horizontal speed depends on the heading.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Vector
from sim_backends.physics.body import Twist
from sim_backends.physics.collisions import TOUCH_M, ContactStop, Surface
from sim_backends.physics.robot_limits import DriveLimits
from sim_backends.world.motion import GRAVITY_M_S2, LEVEL

_LEVEL: Final = (0.0, 0.0)
"""Grade of level ground."""
_REACHED: Final = 1e-12
"""Tolerance for reaching a target, in m/s or rad/s: rounding errors are that large."""

_NO_GRIP_M_S2: Final = 1e-9
"""Below this acceleration the speed cannot be changed on a slope: the remaining friction is a rounding error."""


class DrivePose(NamedTuple):
    """Position and motion of a robot on wheels.

    Attributes:
        place_m: Position of the ground below its centre, metres east, north, up.
        heading_rad: Its heading, from east towards north; it increases beyond a full turn.
        speed_m_s: Forward speed, negative for backwards.
        turn_rad_s: Yaw rate, positive to the left.
        sliding_m_s: Its velocity along an obstacle that it touches; None if it moves along its heading.
        grade: Slope of the ground below it: rise per metre east and north.
    """

    place_m: Vector
    heading_rad: float
    speed_m_s: float = 0.0
    turn_rad_s: float = 0.0
    sliding_m_s: Vector | None = None
    grade: tuple[float, float] = (0.0, 0.0)

    @property
    def tilt_rad(self) -> tuple[float, float]:
        """Implement `Pose.tilt_rad`: the tilt of the ground below it."""
        return LEVEL if self.grade == LEVEL else slope_tilt_rad(self.grade, self.heading_rad)

    @property
    def velocity_m_s(self) -> Vector:
        """Implement `Pose.velocity_m_s`."""
        if self.sliding_m_s is not None:
            return self.sliding_m_s
        level, up = _slope_factors(self.grade, self.heading_rad)
        return (
            self.speed_m_s * level * math.cos(self.heading_rad),
            self.speed_m_s * level * math.sin(self.heading_rad),
            self.speed_m_s * up,
        )


def slope_tilt_rad(grade: tuple[float, float], heading_rad: float) -> tuple[float, float]:
    """Return roll and pitch of a robot on wheels on a slope, from the rise per metre east and north."""
    (east, north), cos, sin = grade, math.cos(heading_rad), math.sin(heading_rad)
    # Slopes of the ground in the robot's forward and left directions.
    forward, left = east * cos + north * sin, north * cos - east * sin
    return math.asin(left / math.hypot(1.0, forward, left)), -math.atan(forward)


@dataclass(frozen=True, slots=True)
class Arc:
    """A course with constant accelerations.

    Attributes:
        start: Its initial pose.
        speed_m_s: Initial speed, equal to the speed of the initial pose except for rounding.
        turn_rad_s: Initial yaw rate, equal to the yaw rate of the initial pose except for rounding.
        acceleration_m_s2: Change of the speed per second.
        turn_acceleration_rad_s2: Change of the yaw rate per second.
        steps: Number of steps for which it is valid; None for no limit.
        step_s: Length of a step.
    """

    start: DrivePose
    speed_m_s: float
    turn_rad_s: float
    acceleration_m_s2: float
    turn_acceleration_rad_s2: float
    steps: int | None
    step_s: float

    @property
    def moves(self) -> bool:
        """Implement `Course.moves`."""
        return bool(self.speed_m_s or self.acceleration_m_s2)

    def at(self, steps: int) -> DrivePose:
        """Implement `Course.at`."""
        if not steps:
            return self.start
        t = steps * self.step_s
        (east_m, north_m, up_m), heading_rad = self.start.place_m, self.start.heading_rad
        mean_m_s = self.speed_m_s + self.acceleration_m_s2 * t / 2
        half_turn_rad = (self.turn_rad_s + self.turn_acceleration_rad_s2 * t / 2) * t / 2
        sinc, bend = _arc(half_turn_rad)
        ahead_m, left_m = mean_m_s * t * sinc, self.acceleration_m_s2 * t * t / 2 * bend
        cos, sin = math.cos(heading_rad + half_turn_rad), math.sin(heading_rad + half_turn_rad)
        east, north = ahead_m * cos - left_m * sin, ahead_m * sin + left_m * cos
        grade = self.start.grade
        if grade != _LEVEL:
            level, _ = _slope_factors(grade, heading_rad + half_turn_rad)
            east, north = east * level, north * level
            up_m += grade[0] * east + grade[1] * north
        return DrivePose(
            (east_m + east, north_m + north, up_m),
            heading_rad + 2 * half_turn_rad,
            self.speed_m_s + self.acceleration_m_s2 * t,
            self.turn_rad_s + self.turn_acceleration_rad_s2 * t,
            None,
            grade,
        )


def _slope_factors(grade: tuple[float, float], heading_rad: float) -> tuple[float, float]:
    """Return the horizontal and the vertical distance per metre driven on a slope."""
    if grade == _LEVEL:
        return 1.0, 0.0
    rise = grade[0] * math.cos(heading_rad) + grade[1] * math.sin(heading_rad)
    level = 1 / math.hypot(1.0, rise)
    return level, rise * level


def _arc(x: float) -> tuple[float, float]:
    """Return sin(x) / x and (sin(x) - x cos(x)) / x^2."""
    if abs(x) < 1e-3:  # the next terms of the series, x^4 / 120 and x^5 / 840, are below rounding errors
        return 1 - x * x / 6, x / 3 - x**3 / 30
    return math.sin(x) / x, (math.sin(x) - x * math.cos(x)) / (x * x)


class DifferentialDrive:
    """A robot on wheels that follows `Twist` commands; without a command it is at rest.

    Args:
        limits: Its limits and size.
        place_m: Position at time 0, metres east and north.
        heading_rad: Its heading, from east towards north.
        antenna_m: Height of its antenna above the ground; None for the height of the robot.
    """

    def __init__(
        self,
        limits: DriveLimits,
        place_m: tuple[float, float],
        heading_rad: float = 0.0,
        *,
        antenna_m: float | None = None,
    ) -> None:
        self._limits = limits
        self.place_m = (*place_m, 0.0)
        self._heading_rad = heading_rad
        self.flies = False
        self.max_grade = limits.friction
        self.radius_m = limits.radius_m
        self.height_m = limits.height_m
        self.antenna_m = limits.height_m if antenna_m is None else antenna_m
        self.top_speed_m_s = limits.speed_m_s

    def initial_pose(self) -> DrivePose:
        """Implement `Body.initial_pose`."""
        return self.pose_at(self.place_m, self._heading_rad)

    def pose_at(self, place_m: Vector, heading_rad: float) -> DrivePose:
        """Implement `Body.pose_at`."""
        return DrivePose((*place_m[:2], 0.0), heading_rad)

    def on_surface(self, pose: DrivePose, surface: Surface) -> DrivePose:
        """Implement `Body.on_surface`."""
        if surface.grade == pose.grade and abs(surface.height_m - pose.place_m[2]) <= TOUCH_M:
            return pose
        return pose._replace(place_m=(*pose.place_m[:2], surface.height_m), grade=surface.grade)

    def course(self, pose: DrivePose, command: object, step_s: float) -> Arc:
        """Implement `Body.course`."""
        limits = self._limits
        twist = require_twist(command)
        speed_m_s = _clamp(twist.forward_m_s, limits.speed_m_s)
        turn_rad_s = _clamp(twist.turn_rad_s, limits.turn_rad_s)
        max_m_s2 = self._acceleration_m_s2(pose, faster=speed_m_s > pose.speed_m_s)
        has_no_grip = max_m_s2 <= _NO_GRIP_M_S2 and speed_m_s != pose.speed_m_s
        if has_no_grip:  # the friction is only sufficient to prevent a slide down the slope
            speed_m_s = pose.speed_m_s
        a_m_s2, speed_steps = _approach(pose.speed_m_s, speed_m_s, max_m_s2, step_s)
        a_rad_s2, turn_steps = _approach(pose.turn_rad_s, turn_rad_s, limits.turn_acceleration_rad_s2, step_s)
        steps = min((count for count in (speed_steps, turn_steps) if count), default=None)
        is_turning = bool(turn_steps or turn_rad_s)
        if (turn_steps or (is_turning and pose.grade != _LEVEL)) and (speed_steps or speed_m_s or has_no_grip):
            steps = 1  # the displacement is approximated step by step, see the top of this module
        return Arc(
            pose,
            pose.speed_m_s if speed_steps else speed_m_s,
            pose.turn_rad_s if turn_steps else turn_rad_s,
            a_m_s2,
            a_rad_s2,
            steps,
            step_s,
        )

    def _acceleration_m_s2(self, pose: DrivePose, *, faster: bool) -> float:
        """Return the maximum change of its speed per second on the ground below it.

        The friction force is at most friction times the normal force, m g cos(slope), in any direction. Its component
        across the heading must prevent a sideways slide; the rest accelerates or brakes the robot along its heading,
        with or against gravity.

        Args:
            pose: The pose.
            faster: True if its forward speed must increase, False if it must decrease.
        """
        limits = self._limits
        if pose.grade == _LEVEL:
            return min(limits.acceleration_m_s2, limits.friction * GRAVITY_M_S2)
        steepness = math.hypot(*pose.grade)
        normal_m_s2 = GRAVITY_M_S2 / math.hypot(1.0, steepness)
        _, up = _slope_factors(pose.grade, pose.heading_rad)
        downhill_m_s2 = GRAVITY_M_S2 * up
        sideways_m_s2 = math.sqrt(max((steepness * normal_m_s2) ** 2 - downhill_m_s2**2, 0.0))
        grip_m_s2 = math.sqrt(max((limits.friction * normal_m_s2) ** 2 - sideways_m_s2**2, 0.0))
        return min(limits.acceleration_m_s2, grip_m_s2 - downhill_m_s2 if faster else grip_m_s2 + downhill_m_s2)

    def after_contact(self, pose: DrivePose, stop: ContactStop, command: object) -> DrivePose:
        """Implement `Body.after_contact`.

        At a wall it continues with the component of its velocity along the wall, limited to the same component of the
        commanded velocity; a robot that heads straight into a wall stops.
        """
        heading: Vector = (math.cos(pose.heading_rad), math.sin(pose.heading_rad), 0.0)
        direction: Vector = stop.sliding_velocity(heading if pose.speed_m_s > 0 else (-heading[0], -heading[1], 0.0))
        share = math.hypot(*direction)
        max_m_s = min(abs(pose.speed_m_s), abs(require_twist(command).forward_m_s) * share)
        return pose._replace(
            place_m=stop.place_m,
            speed_m_s=math.copysign(max_m_s, pose.speed_m_s),
            sliding_m_s=(max_m_s * direction[0], max_m_s * direction[1], 0.0),
        )

    def limit_m_s2(self, pose: DrivePose) -> float:
        """Implement `Body.limit_m_s2`: the motors accelerate along the heading, and a turn across it."""
        limits = self._limits
        stretch = math.hypot(1.0, *pose.grade)
        return math.hypot(limits.acceleration_m_s2, limits.speed_m_s * limits.turn_rad_s * stretch)


def require_twist(command: object) -> Twist:
    """Return a command to a robot on wheels; None means a twist of 0.

    Raises:
        ConfigurationError: The command is not a `Twist` of finite numbers.
    """
    if command is None:
        return Twist()
    if not isinstance(command, Twist) or not (
        math.isfinite(command.forward_m_s) and math.isfinite(command.turn_rad_s)
    ):
        raise ConfigurationError(
            f"a robot on wheels cannot follow {command!r}", remedy="use a Twist of finite numbers"
        )
    return command


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(value, limit))


def _approach(value: float, target: float, limit: float, step_s: float) -> tuple[float, int]:
    """Return the rate at which a value approaches its target, and the number of whole steps; 0 and 0 at the target.

    A remainder that is less than a whole step at the limit is covered in one step at a smaller rate.
    """
    difference = target - value
    if abs(difference) <= _REACHED:
        return 0.0, 0
    steps = math.floor(abs(difference) / (limit * step_s) + 1e-9)
    return (math.copysign(limit, difference), steps) if steps else (difference / step_s, 1)
